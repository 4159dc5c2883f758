"""Whole recordings: files, formats, determinism, and what the command refuses."""

from __future__ import annotations

import argparse
import filecmp
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from plyfile import PlyData
from rosbags.highlevel import AnyReader

from vli_common.calibration import load_calibration
from vli_common.errors import ConfigError, OutputError
from vli_common.geometry import inverse, rotation_from_quaternion, transform
from vli_simulation.cli import add_arguments, run
from vli_simulation.config import SimulationError, make_config
from vli_simulation.scenes import SCENES, make_scene
from vli_simulation.simulate import SeenCloud

TINY = ("--preset", "smoke", "--duration", "0.3", "--no-rest", "--resolution", "160x120", "--seed", "5")


def _run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return run(parser.parse_args(arguments))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulation") / "keyboard"
    assert _run("keyboard", "--out", str(out), *TINY, "--workers", "1", "--exposure-topic") == 0
    return out


def _messages(bag: Path, topic: str) -> list[tuple[int, object]]:
    with AnyReader([bag]) as reader:
        connections = [connection for connection in reader.connections if connection.topic == topic]
        return [(stamp, reader.deserialize(raw, connection.msgtype)) for connection, stamp, raw in reader.messages(connections)]


def test_the_result_does_not_depend_on_the_number_of_workers(recording: Path, tmp_path: Path) -> None:
    assert _run("keyboard", "--out", str(tmp_path / "again"), *TINY, "--workers", "2", "--exposure-topic") == 0
    names = [path.relative_to(recording) for path in recording.rglob("*") if path.is_file()]
    assert len(names) == 8
    assert filecmp.cmpfiles(recording, tmp_path / "again", map(str, names), shallow=False)[1:] == ([], [])


def test_images_alternate_long_and_short_at_60_hz(recording: Path) -> None:
    images = _messages(recording / "bag", "/camera/image_raw/compressed")
    stamps = [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for _, message in images]
    assert stamps == [log for log, _ in images]
    np.testing.assert_allclose(np.diff(stamps), 1e9 / 60, atol=1)
    brightness = [cv2.imdecode(message.data, cv2.IMREAD_COLOR).mean() for _, message in images]
    assert len(brightness) == 18
    assert min(brightness[::2]) > 3 * max(brightness[1::2])
    assert images[0][1].header.frame_id == "camera_optical_frame"


def test_exposures_and_camera_info_belong_to_the_frames(recording: Path) -> None:
    stamps = [stamp for stamp, _ in _messages(recording / "bag", "/camera/image_raw/compressed")]
    exposures = _messages(recording / "bag", "/camera/exposure")
    assert [stamp for stamp, _ in exposures] == stamps
    values = [{pair.key: pair.value for pair in message.status[0].values} for _, message in exposures]
    assert values[:2] == [{"exposure_s": "0.005", "laser": "off"}, {"exposure_s": "0.0004", "laser": "on"}]
    calibration = load_calibration(recording / "calibration.yaml")
    infos = _messages(recording / "bag", "/camera/camera_info")
    assert [stamp for stamp, _ in infos] == stamps
    np.testing.assert_allclose(infos[0][1].k.reshape(3, 3), calibration.camera.matrix)


def test_the_imu_covers_the_frames(recording: Path) -> None:
    frames = _messages(recording / "bag", "/camera/image_raw/compressed")
    imu = _messages(recording / "bag", "/imu")
    assert imu[0][0] < frames[0][0]
    assert imu[-1][0] > frames[-1][0]
    np.testing.assert_allclose(np.diff([stamp for stamp, _ in imu]), 5_000_000, atol=1)
    assert np.linalg.norm([getattr(imu[3][1].linear_acceleration, axis) for axis in "xyz"]) == pytest.approx(9.81, abs=1.5)


def test_the_calibration_is_valid_and_exact(recording: Path) -> None:
    calibration = load_calibration(recording / "calibration.yaml")
    assert calibration.laser is not None
    assert np.linalg.norm(calibration.laser.normal) == pytest.approx(1.0, abs=1e-12)
    assert calibration.laser.d > 0
    assert calibration.T_cam_imu is not None
    np.testing.assert_allclose(calibration.T_cam_imu @ inverse(calibration.T_cam_imu), np.eye(4), atol=1e-12)


def test_truth_has_a_pose_for_every_frame_and_sees_the_surface(recording: Path) -> None:
    lines = (recording / "truth.tum").read_text().split("\n")[:-1]
    stamps = [stamp for stamp, _ in _messages(recording / "bag", "/camera/image_raw/compressed")]
    assert [int(line.split()[0].replace(".", "")) for line in lines] == stamps
    values = np.array([[float(value) for value in line.split()[1:]] for line in lines])
    rotation = rotation_from_quaternion(values[:, 3:])
    assert np.all(rotation[:, 2, 2] < -0.9)
    passes = json.loads((recording / "passes.json").read_text())
    assert passes["length_m"] == pytest.approx(np.linalg.norm(np.diff(values[:, :3], axis=0), axis=1).sum(), abs=1e-6)
    assert passes["passes"] == [[1_700_000_000.0, 1_700_000_000.3]]


def test_surface_and_seen_points_agree(recording: Path) -> None:
    surface = PlyData.read(recording / "surface.ply")
    assert surface["vertex"]["x"].dtype == np.float64
    vertices = np.stack([surface["vertex"][axis] for axis in "xyz"], axis=1)
    assert len(surface["face"]) > 100_000
    seen = PlyData.read(recording / "seen.ply")["vertex"]
    names = ["x", "y", "z", "red", "green", "blue", "albedo_red", "albedo_green", "albedo_blue"]
    assert [prop.name for prop in seen.properties] == names
    points = np.stack([seen[axis] for axis in "xyz"], axis=1)
    assert len(points) > 500
    assert np.all((points > vertices.min(axis=0) - 1e-6) & (points < vertices.max(axis=0) + 1e-6))


def test_seen_points_are_thinned_to_one_in_a_cube() -> None:
    cloud = SeenCloud()
    grey = np.full((3, 3), 9, np.uint8)
    cloud.add(np.array([[1e-5, 1e-5, 1e-5], [2e-5, 2e-5, 2e-5], [-1e-5, 1e-5, 1e-5]]), grey, grey)
    cloud.add(np.array([[3e-5, 1e-5, 1e-5], [1e-3, 0, 0], [2e-3, 0, 0]]), grey, grey)
    assert len(cloud.rows()) == 4


def test_an_existing_directory_is_kept_unless_told_otherwise(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(OutputError, match=r"is not empty; choose another with --out DIR, or replace it with --overwrite"):
        _run("keyboard", "--out", str(tmp_path), *TINY)
    assert (tmp_path / "mine.txt").read_text() == "precious"


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (("--lens", "fisheye"), ConfigError, "'rig.lens' is 'fisheye', expected one of radtan, equidistant, none"),
        (("--set", "sensor.specle=1"), ConfigError, "unknown parameter 'sensor.specle', did you mean 'sensor.speckle'"),
        (("--distance", "0.5"), ConfigError, "'motion.distance' is '0.5', expected 0.015 to 0.15 m"),
        (("--set", "sensor.quality=["), ConfigError, r"--set sensor.quality=\[. is not YAML"),
        (("--seed", "-1"), SimulationError, "--seed '-1' or --workers 'None' is out of range"),
        (("--duration", "60"), SimulationError, "is longer than the scene"),
    ],
)
def test_impossible_wishes_are_refused(tmp_path: Path, arguments: tuple[str, ...], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        _run("keyboard", "--out", str(tmp_path / "out"), *TINY, *arguments)
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "out.partial").exists()


def test_an_unknown_preset_or_scene_is_refused() -> None:
    with pytest.raises(SimulationError, match="unknown preset 'tiny', expected one of smoke, short, full"):
        make_config("tiny")
    with pytest.raises(SimulationError, match="unknown scene 'moon', expected one of keyboard, pipe, part"):
        make_scene("moon", 0)


def test_a_scene_follows_from_its_seed() -> None:
    first, again, other = (make_scene("keyboard", seed).mesh.vertices for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


@pytest.mark.parametrize("name", sorted(SCENES))
def test_each_scene_is_a_sound_mesh_long_enough_for_the_full_preset(name: str) -> None:
    scene = make_scene(name, 7)
    mesh = scene.mesh
    assert np.all(np.isfinite(mesh.vertices))
    assert mesh.faces.min() == 0
    assert mesh.faces.max() == len(mesh.vertices) - 1
    assert mesh.material.max() < len(scene.materials)
    assert mesh.tile.max() < len(scene.tiles)
    assert scene.path.length > 0.31
    assert scene.path.direction @ scene.path.normal == pytest.approx(0, abs=1e-9)
    along = transform(np.eye(4), scene.path.origin[None] + np.linspace(0, scene.path.length, 5)[:, None] * scene.path.direction)
    gaps = np.linalg.norm(mesh.vertices[None] - along[:, None], axis=2).min(axis=1)
    assert gaps.max() < 0.012
