"""TUM files: every nanosecond comes back, and what is no trajectory is told with its line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from trajectories import wavy, write_tum

from vli_bringup.tum import read_tum
from vli_common.errors import InputError

GOOD = "1.5 0 0 0 0 0 0 1"


def test_a_trajectory_comes_back_to_the_nanosecond(tmp_path: Path) -> None:
    trajectory = wavy(50)
    write_tum(tmp_path / "t.tum", trajectory)
    again = read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(again.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_allclose(again.poses, trajectory.poses, atol=1e-14)


def test_comments_blank_lines_and_scientific_stamps_are_read(tmp_path: Path) -> None:
    path = tmp_path / "t.tum"
    path.write_text(f"# t x y z\n\n{GOOD}\n  \n1.7e+09 0 0 0 0 0 1 0\n")
    trajectory = read_tum(path)
    assert trajectory.stamps_ns.tolist() == [1_500_000_000, 1_700_000_000_000_000_000]
    np.testing.assert_allclose(trajectory.poses[1, :3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-15)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "does not exist, expected a TUM file"),
        (b"", "holds no pose"),
        (b"# only a comment\n", "holds no pose"),
        (b"\xff\xfe\x00\x01", "cannot be read as text"),
        (b"1.5,0,0,0,0,0,0,1\n", r"line 1: '1.5,0,0,0,0,0,0,1' is not a TUM pose, expected 't x y z qx qy qz qw'"),
        (f"{GOOD}\n1.6 0 0 0 0 0 1\n".encode(), "line 2: .* is not a TUM pose"),
        (f"{GOOD} 9\n".encode(), "line 1: .* is not a TUM pose"),
        (f"# c\n{GOOD}\n\nx 0 0 0 0 0 0 1\n".encode(), "line 4: .* is not a TUM pose"),
        (b"inf 0 0 0 0 0 0 1\n", "line 1: .* is not a TUM pose"),
        (b"nan 0 0 0 0 0 0 1\n", "line 1: .* is not a TUM pose"),
        (b"1 0 nan 0 0 0 0 1\n", "line 1: .* is not finite"),
        (b"1 0 0 0 0 0 0 0\n", "line 1: quaternion has norm '0', expected 1"),
        (f"{GOOD}\n{GOOD}\n".encode(), "line 2: stamp '1.5' does not increase"),
    ],
)
def test_what_is_no_trajectory_is_told(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "t.tum"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_tum(path)


def test_a_directory_is_no_trajectory(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_tum(tmp_path)
