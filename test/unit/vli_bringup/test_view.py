"""What ``vli view`` puts into the scene, and who can see it."""

from __future__ import annotations

import json
import socket
import sys
import urllib.request
from argparse import ArgumentParser
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_bag import TinyBag, write_calibration

from vli_bringup import view
from vli_bringup.cli import main
from vli_bringup.recorder import tum_text
from vli_bringup.viewing.colouring import COLOURINGS
from vli_bringup.viewing.live import LiveDisplay, status_text
from vli_bringup.viewing.map_display import MapDisplay
from vli_bringup.viewing.results import show_results
from vli_bringup.viewing.scene import Scene
from vli_common.errors import InputError
from vli_common.geometry import pose
from vli_common.ply import write_cloud
from vli_common.status import Health, NodeState, StageStatus
from vli_common.types import PointCloud

pytest.importorskip("viser")


def free_port() -> int:
    with socket.socket() as item:
        item.bind(("127.0.0.1", 0))
        return int(item.getsockname()[1])


@pytest.fixture
def scene() -> Iterator[Scene]:
    with Scene("test", free_port()) as item:
        yield item


def node(scene: Scene, name: str) -> Any:
    """Return what browsers are shown under a name, None where there is nothing."""
    return scene.server.scene._handle_from_node_name.get(name)


def cloud(count: int, session: int = 0) -> PointCloud:
    random = np.random.default_rng(0)
    normals = np.zeros((count, 3), np.float32)
    normals[: count // 2, 2] = 1.0
    return PointCloud(
        stamp_ns=0,
        points=random.uniform(-0.05, 0.05, (count, 3)).astype(np.float32),
        colours=random.integers(0, 256, (count, 3), np.uint8),
        normals=normals,
        weights=np.arange(1, count + 1, dtype=np.float32),
        session=session,
    )


def write_results(directory: Path, points: int, poses: int) -> Path:
    directory.mkdir()
    write_cloud(directory / "map.ply", cloud(points))
    trajectory = {100 + index: pose(np.eye(3), np.array([1e-3 * index, 0.0, 0.03])) for index in range(poses)}
    for name in ("trajectory.tum", "trajectory_final.tum"):
        (directory / name).write_text(tum_text(trajectory))
    states = [[1.0, "TRACKING", "started at rest"]]
    (directory / "summary.json").write_text(json.dumps({"frames_long": 750, "points": points, "states": states}))
    return directory


def test_colourings_say_normal_weight_and_height() -> None:
    item = cloud(100)
    assert COLOURINGS["colour"](item) is item.colours
    normals = COLOURINGS["normals"](item)
    assert normals[0].tolist() == [128, 128, 255]
    assert normals[-1].tolist() == [128, 128, 128]
    weights = COLOURINGS["weight"](item).astype(int).sum(axis=1)
    assert weights[0] < weights[50] < weights[-1]
    height = COLOURINGS["height"](item).astype(int).sum(axis=1)
    order = np.argsort(item.points[:, 2])
    assert height[order[0]] < height[order[50]] < height[order[-1]]


def test_colourings_take_clouds_without_normals_weights_and_points() -> None:
    empty = np.empty((0, 3), np.float32)
    for item in (
        PointCloud(0, empty, empty.astype(np.uint8)),
        PointCloud(0, np.ones((3, 3), np.float32), np.ones((3, 3), np.uint8)),
    ):
        assert {COLOURINGS[name](item).shape for name in COLOURINGS} == {(len(item), 3)}


def test_nobody_but_this_machine_is_served(scene: Scene) -> None:
    with urllib.request.urlopen(scene.url, timeout=10) as answer:
        assert answer.status == 200
    port = scene.server.get_port()
    lines = [line.split() for table in ("tcp", "tcp6") for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]]
    listening = {line[1].split(":")[0] for line in lines if line[3] == "0A" and int(line[1].split(":")[1], 16) == port}
    assert listening == {"0100007F"}


def test_results_show_every_point_both_trajectories_and_the_figures(scene: Scene, tmp_path: Path) -> None:
    shown = show_results(scene, write_results(tmp_path / "scan", points=500, poses=250))
    assert len(shown) == 500
    points = node(scene, "/map").points
    assert points.dtype == np.float32
    np.testing.assert_array_equal(points, cloud(500).points)
    for name in ("/live/path", "/final/path"):
        assert node(scene, name).points.shape == (249, 2, 3)
    assert node(scene, "/final/cameras").points.shape == (84 * 8, 2, 3)
    assert node(scene, "/final/cameras").visible
    assert not node(scene, "/live/cameras").visible


def test_a_map_alone_is_shown_and_a_directory_without_one_is_told(
    scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_cloud(tmp_path / "map.ply", cloud(10))
    assert view.is_result(tmp_path / "map.ply")
    assert len(show_results(scene, tmp_path / "map.ply")) == 10
    (tmp_path / "empty").mkdir()
    assert main(["view", str(tmp_path / "empty"), "--port", str(free_port())]) == 2
    assert "holds no .mcap or .db3 file" in capsys.readouterr().err


def test_a_broken_summary_is_told(scene: Scene, tmp_path: Path) -> None:
    directory = write_results(tmp_path / "scan", points=5, poses=3)
    (directory / "summary.json").write_text("[")
    with pytest.raises(InputError, match="is no summary of a run"):
        show_results(scene, directory)


def test_the_controls_of_the_map_change_how_it_looks(scene: Scene) -> None:
    display = MapDisplay(scene)
    display.show(cloud(100))
    display.colouring.value = "normals"
    np.testing.assert_array_equal(node(scene, "/map").colors, COLOURINGS["normals"](cloud(100)))
    display.size_mm.value = 1.0
    assert node(scene, "/map").point_size == pytest.approx(1e-3)
    display.visible.value = False
    assert not node(scene, "/map").visible
    display.show(cloud(200))
    assert not node(scene, "/map").visible
    np.testing.assert_array_equal(node(scene, "/map").colors, COLOURINGS["normals"](cloud(200)))


def test_a_bag_is_stepped_through_by_kind_of_exposure(tmp_path: Path, scene: Scene) -> None:
    bag = TinyBag(seconds=3.0).write(tmp_path / "bag")
    parser = ArgumentParser()
    view.add_arguments(parser)
    calibration = write_calibration(tmp_path / "calibration.yaml")
    display = view.show_bag(scene, parser.parse_args([str(bag), "--calib", str(calibration), "--duration", "2.5"]))
    assert "long exposure" in display.text.content
    display.kind.value = "short"
    display.step(1)
    assert display.index.value == 1
    assert "no stripe within the laser's range" in display.text.content
    display.step(1)
    assert display.index.value == 3
    display.step(-1)
    display.step(-1)
    assert display.index.value == 1
    assert node(scene, "/stripe").points.shape == (0, 3)


def test_a_running_scan_shows_map_updates_and_stripes_of_one_session(scene: Scene) -> None:
    display = LiveDisplay(scene)
    display.add_update(cloud(30))
    display.add_update(cloud(20))
    assert [len(node(scene, f"/updates/{number}").points) for number in (1, 2)] == [30, 20]
    display.add_map(cloud(50))
    assert node(scene, "/updates/1") is None
    assert len(node(scene, "/map").points) == 50
    display.add_stripes(cloud(7))
    display.add_path(np.stack([np.eye(4)] * 3))
    display.add_pose(np.eye(4))
    assert (len(node(scene, "/stripes").points), node(scene, "/path").points.shape[0]) == (7, 2)
    display.add_stripes(cloud(4, session=1))
    assert node(scene, "/path") is None
    assert (len(node(scene, "/stripes").points), len(node(scene, "/map").points)) == (4, 0)


def test_who_comes_late_looks_at_all_of_the_map(scene: Scene) -> None:
    display = LiveDisplay(scene)
    small, large = cloud(50), cloud(50)
    large.points[:] *= 10.0
    display.add_stripes(small)
    near = np.linalg.norm(scene.server.initial_camera.position - scene.server.initial_camera.look_at)
    display.add_stripes(large)
    assert np.linalg.norm(scene.server.initial_camera.position - scene.server.initial_camera.look_at) == pytest.approx(near)
    display.add_map(large)
    far = np.linalg.norm(scene.server.initial_camera.position - scene.server.initial_camera.look_at)
    assert far == pytest.approx(10 * near, rel=1e-3)


def test_the_state_of_a_running_scan_is_in_words(scene: Scene) -> None:
    display = LiveDisplay(scene)
    assert "nothing has come yet" in display.text.content
    values = {"tracking": "LOST", "reason": "no features"}
    display.add_status(StageStatus(0, "backend_node", Health.ERROR, NodeState.READY, "move slower", values))
    display.add_status(StageStatus(0, "demux_node", Health.OK, NodeState.READY, "", {"latency_p50_ms": "3.10"}))
    assert display.text.content.split("\n\n") == [
        "## LOST",
        "no features",
        "- ✗ **backend_node** ready: move slower",
        "- ✓ **demux_node** ready (3.10 ms)",
    ]
    assert status_text({}) == ""


@pytest.mark.parametrize("arguments", [[], ["x", "--live"]])
def test_one_thing_is_viewed_at_a_time(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", *arguments]) == 2
    assert "expected either a DIR, a BAG or --live" in capsys.readouterr().err


def test_without_viser_the_command_that_installs_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert "pip install 'vli_bringup[view]'" in told
    assert told.count("\n") == 1
