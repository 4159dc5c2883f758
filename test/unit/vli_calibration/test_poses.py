from __future__ import annotations

import numpy as np
import pytest

from vli_calibration.poses import read_poses
from vli_common.errors import InputError

RECORD = "[0.1, 0.2, 0.3]\n[0.0, 0.0, 0.7071, 0.7071]\nim1.png\n"
SECOND = "[0.4, 0.5, 0.6]\n[0.0, 0.0, 0.0, 1.0]\nim2.png\n"


@pytest.fixture
def read(tmp_path):
    def write_and_read(text):
        (tmp_path / "data.txt").write_text(text)
        return read_poses(tmp_path / "data.txt")

    return write_and_read


def test_three_lines_make_a_pose_of_the_tool_in_the_base(read):
    T = read(RECORD + SECOND)["im1.png"]
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [0.1, 1.2, 0.3, 1], atol=1e-4)


def test_rounded_quaternions_become_rotations(read):
    T = read(RECORD.replace("0.7071", "0.71"))["im1.png"]
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_empty_lines_comments_and_windows_line_ends_are_passed_over(read):
    poses = read("# arm\r\n\r\n" + RECORD.replace("\n", "\r\n") + "   # (quat xyzw)\n" + SECOND + "\n\n")
    assert list(poses) == ["im1.png", "im2.png"]


def test_a_bare_list_of_names_is_no_poses(read):
    assert read("im1.png\nim2.png\n") == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty; expected three lines an image"),
        ("im1.png\nim1.png\n", "line 2: 'im1.png' has a pose already"),
        ("im1.png\nhello\n", "line 2 is 'hello', expected the file name of an image"),
        (RECORD + "im2.png\n", "line 4 is 'im2.png', expected the position [x, y, z]"),
        (RECORD + "[0.0, 0.0, 0.0, 1.0]\n[0.1, 0.2, 0.3]\nim2.png\n", "line 4 is '[0.0, 0.0, 0.0, 1.0]', expected the position"),
        (RECORD + "[0.1, 0.2, 0.3]\nim2.png\n", "line 5 is 'im2.png', expected the quaternion [qx, qy, qz, qw]"),
        (RECORD + "[0.1, 0.2, 0.3]\n[0, 0, 0, 1]\n", "ends after line 5, expected the name of an image"),
        (RECORD + "[0.1, 0.2, 0.3]\n", "ends after line 4, expected [qx, qy, qz, qw]"),
        (RECORD + "[0.1, nan, 0.3]\n[0, 0, 0, 1]\nim2.png\n", "line 4 is '[0.1, nan, 0.3]', expected the position"),
        (RECORD + "[0.1, x, 0.3]\n[0, 0, 0, 1]\nim2.png\n", "line 4 is '[0.1, x, 0.3]', expected the position"),
        (RECORD + "[0.1, 0.2, 0.3]\n[0, 0, 0, 2]\nim2.png\n", "line 5: quaternion of norm '2', expected 1"),
        (RECORD + "[0.1, 0.2, 0.3]\n[0, 0, 0, 0]\nim2.png\n", "line 5: quaternion of norm '0', expected 1"),
        (RECORD + RECORD, "line 6: 'im1.png' has a pose already"),
        (RECORD + "[0.1, 0.2, 0.3]\n[0, 0, 0, 1]\n[0.1, 0.2, 0.3]\n", "line 6 is '[0.1, 0.2, 0.3]', expected the file name"),
        (RECORD[:9] + "\n", "line 1 is '[0.1, 0.2', expected the position"),
    ],
)
def test_a_damaged_file_is_refused_with_the_line_and_what_belongs_there(read, text, said):
    with pytest.raises(InputError) as caught:
        read(text)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_or_no_text_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file; expected three lines an image"):
        read_poses(tmp_path / "none.txt")
    (tmp_path / "photo.png").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(InputError, match="cannot be read"):
        read_poses(tmp_path / "photo.png")


def test_the_files_that_came_with_real_arms_are_read(shared_data):
    directory = shared_data / "blaser_calibration"
    assert len(read_poses(directory / "640_unified" / "data.txt")) == 25
    assert len(read_poses(directory / "640_v1_laser_off" / "data.txt")) == 9
    assert read_poses(directory / "handheld_1280x720" / "data.txt") == {}
