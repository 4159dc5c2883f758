"""Calibration data: what is drawn and written agrees with the truth beside it."""

from __future__ import annotations

import argparse
import ast
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader

from vli_calibration.targets import parse_target
from vli_common.arrays import FloatArray
from vli_common.calibration import load_calibration
from vli_common.errors import InputError, OutputError, VliError
from vli_common.geometry import inverse, pose, rotation_from_quaternion, so3_log, transform
from vli_driver.config import StripeConfig
from vli_driver.stripe import CentreOfMassDetector
from vli_driver.triangulation import full_band, stripe_runs_across_columns
from vli_simulation.board.config import make_board_config
from vli_simulation.board.recordings import MovingBoard
from vli_simulation.board.simulate import BoardSimulation
from vli_simulation.cli import add_arguments, run
from vli_simulation.config import SimulationError
from vli_simulation.imu import record_rest
from vli_simulation.rig import make_rig
from vli_simulation.writer import BagWriter

BOARD = "chessboard:7x5:0.004"
SMALL = {"rig.width": 320, "rig.height": 240}
QUIET = {"sensor.read_noise_e": 0.0, "sensor.full_well_e": 1e6, "sensor.vignetting": 0.0, "sensor.speckle": 0.0}


def _run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return run(parser.parse_args(["board", *arguments]))


def _simulation(target: str = BOARD, seed: int = 2, **overrides: object) -> BoardSimulation:
    return BoardSimulation(parse_target(target), make_board_config({**SMALL, **overrides}), seed)


def _poses(directory: Path) -> dict[str, FloatArray]:
    truth = yaml.safe_load((directory / "truth.yaml").read_text())
    return {name: np.array(values["T_cam_board"]) for name, values in truth["board_poses"].items()}


@pytest.fixture(scope="module")
def stills(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("board") / "set"
    noise_free = [part for key, value in QUIET.items() for part in ("--set", f"{key}={value}")]
    arguments = ("--parts", "camera", "laser", "--images", "4", "--target", BOARD, "--seed", "4")
    assert _run("--out", str(out), *arguments, *noise_free, "--set", "board.shake=0.0") == 0
    return out


def test_corners_stand_where_they_project_to(stills: Path) -> None:
    camera, target = load_calibration(stills / "calibration.yaml").camera, parse_target(BOARD)
    errors = []
    for name, T_cam_board in _poses(stills).items():
        if name.endswith("_short.png"):
            continue
        expected = camera.project(transform(T_cam_board, target.points))
        grey = cv2.imread(str(stills / name), cv2.IMREAD_GRAYSCALE)
        found = cv2.cornerSubPix(
            grey, expected.astype(np.float32).reshape(-1, 1, 2).copy(), (4, 4), (-1, -1), (cv2.TERM_CRITERIA_COUNT, 60, 0.0)
        )
        errors.append(found[:, 0] - expected)
    together = np.concatenate(errors)
    assert len(together) == 8 * 35
    # The detector itself scatters by some 0.04 px on ideal images; a bias of the renderer would survive the mean.
    assert np.abs(together.mean(axis=0)).max() < 0.01
    assert np.abs(np.median(together, axis=0)).max() < 0.015
    assert np.linalg.norm(together, axis=1).mean() < 0.08


def test_the_stripe_lies_where_plane_and_board_meet(stills: Path) -> None:
    calibration, target = load_calibration(stills / "calibration.yaml"), parse_target(BOARD)
    camera, laser = calibration.camera, calibration.laser
    assert laser is not None
    along = stripe_runs_across_columns(laser)
    detector = CentreOfMassDetector(StripeConfig(), full_band(camera.width, camera.height, along))
    x0, y0, x1, y1 = target.extent
    seen, offsets_px = 0, []
    for name, T_cam_board in _poses(stills).items():
        if not name.endswith("_short.png"):
            continue
        pixels = detector.detect(cv2.imread(str(stills / name))).pixels
        rays = np.column_stack([camera.unproject(pixels), np.ones(len(pixels))])
        normal = T_cam_board[:3, 2]
        points = rays * ((normal @ T_cam_board[:3, 3]) / (rays @ normal))[:, None]
        on_board = transform(inverse(T_cam_board), points)[:, :2]
        inside = np.all(
            (on_board > [x0 - target.margin, y0 - target.margin]) & (on_board < [x1 + target.margin, y1 + target.margin]), axis=1
        )
        errors = (points @ laser.normal + laser.d)[inside] / points[inside, 2] * camera.focal_px
        seen += int(inside.sum())
        offsets_px.append(np.median(errors))
    assert seen > 500
    assert np.abs(offsets_px).max() < 0.1
    assert abs(np.mean(offsets_px)) < 0.03


def test_images_cover_tilts_and_distances(stills: Path) -> None:
    poses = _poses(stills)
    assert sorted(path.name for path in (stills / "camera").iterdir()) == [f"{index:03d}.png" for index in range(4)]
    assert sorted(path.name for path in (stills / "laser").iterdir())[:3] == ["000_long.png", "000_short.png", "001_long.png"]
    middle = np.array([[0.012, 0.008, 0.0]])
    depths = [transform(T, middle)[0, 2] for name, T in poses.items() if name.endswith("_short.png")]
    assert max(depths) > 3.0 * min(depths)
    tilts = [np.rad2deg(np.arccos(T[2, 2])) for T in poses.values()]
    assert max(tilts) > 15
    assert max(tilts) <= 45.01


def test_an_arm_logs_where_it_held_the_sensor(tmp_path: Path) -> None:
    out = tmp_path / "arm"
    arguments = ("--parts", "laser", "--images", "3", "--arm", "--target", BOARD, "--resolution", "320x240")
    assert _run("--out", str(out), *arguments, "--set", "board.arm_noise_m=0.0", "--set", "board.arm_noise_rad=0.0") == 0
    lines = (out / "laser" / "data.txt").read_text().split("\n")[:-1]
    truth = yaml.safe_load((out / "truth.yaml").read_text())
    T_base_board, T_tool_cam = (np.array(truth["arm"][key]) for key in ("T_base_board", "T_tool_cam"))
    # Three with the board and one of the stripe alone.
    assert [line for line in lines if line.endswith(".png")] == ["000.png", "001.png", "002.png", "003.png"]
    for position, quaternion, name in zip(lines[::3], lines[1::3], lines[2::3], strict=True):
        T_base_tool = pose(rotation_from_quaternion(np.array(ast.literal_eval(quaternion))), np.array(ast.literal_eval(position)))
        T_cam_board = np.array(truth["board_poses"][f"laser/{name}"]["T_cam_board"])
        np.testing.assert_allclose(T_base_tool @ T_tool_cam @ T_cam_board, T_base_board, atol=1e-9)
    board, alone = (cv2.imread(str(out / "laser" / name)).astype(float) for name in ("000.png", "003.png"))
    assert np.median(board) > 4 * np.median(alone)
    assert alone[..., 2].max() > 150


def test_the_imu_of_the_moving_bag_agrees_with_the_camera() -> None:
    offset = 0.0215
    simulation = _simulation(**{"board.time_offset_s": offset, "imu.noise_scale": 0.0, "motion.duration_s": 6.0})
    moving = MovingBoard(simulation)
    imu, T_cam_imu = moving.imu(), simulation.rig.T_cam_imu
    assert simulation.rig.document["cam0"]["timeshift_cam_imu"] == offset
    # By the camera's clock a sample was taken at t_cam = t_imu − timeshift.
    stamps_s = (imu.stamps_ns - simulation.start_ns) / 1e9 - offset
    times = moving.offsets_ns / 1e9
    rotations = moving.poses[:, :3, :3]
    rate = so3_log(np.swapaxes(rotations[:-2], 1, 2) @ rotations[2:]) / (times[2:] - times[:-2])[:, None] @ T_cam_imu[:3, :3]
    measured = np.stack([np.interp(times[1:-1], stamps_s, imu.gyro[:, axis]) for axis in range(3)], axis=1)
    assert np.abs(measured).max() > 0.5
    assert np.sqrt(np.mean((measured - rate) ** 2)) < 0.01
    T_world_imu = moving.poses @ T_cam_imu
    acceleration = np.gradient(np.gradient(T_world_imu[:, :3, 3], times, axis=0), times, axis=0)
    force = np.einsum("nji,nj->ni", T_world_imu[:, :3, :3], acceleration + np.array([0, 0, 9.81]))[3:-3]
    measured = np.stack([np.interp(times[3:-3], stamps_s, imu.accel[:, axis]) for axis in range(3)], axis=1)
    assert np.sqrt(np.mean((measured - force) ** 2)) < 0.08


def test_the_moving_bag_excites_all_axes_and_keeps_the_board_in_view() -> None:
    simulation = _simulation(**{"motion.duration_s": 20.0, "motion.rest_s": 0.0})
    moving = MovingBoard(simulation)
    imu = moving.imu()
    assert (imu.gyro.std(axis=0) > 0.15).all()
    assert (imu.accel.std(axis=0) > 0.15).all()
    views = [inverse(moving.view(index).T_world_cam) for index in range(0, len(moving), 20)]
    pixels = [simulation.rig.camera.project(transform(T, simulation.target.points)) for T in views]
    whole = [bool(np.all((found > 0) & (found < [319, 239]))) for found in pixels]
    assert np.mean(whole) > 0.7


def test_a_bag_has_the_usual_topics_and_stamps(tmp_path: Path) -> None:
    out = tmp_path / "moving"
    small = ("--resolution", "160x120", "--set", "motion.duration_s=0.3", "--no-rest", "--target", "chessboard:4x3:0.008")
    assert _run("--out", str(out), "--parts", "bag", *small, "--time-offset", "-0.01") == 0
    with AnyReader([out / "bag"]) as reader:
        messages = [(connection.topic, reader.deserialize(raw, connection.msgtype)) for connection, _, raw in reader.messages()]
    stamps = {
        topic: [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for name, message in messages if name == topic]
        for topic in ("/camera/image_raw/compressed", "/camera/camera_info", "/imu")
    }
    images = stamps["/camera/image_raw/compressed"]
    assert images == stamps["/camera/camera_info"]
    assert [int(line.split()[0].replace(".", "")) for line in (out / "truth.tum").read_text().splitlines()] == images
    np.testing.assert_allclose(np.diff(images), 1e9 / 60, atol=1)
    brightness = [cv2.imdecode(message.data, 1).mean() for name, message in messages if name.endswith("compressed")]
    assert min(brightness[::2]) > 2 * max(brightness[1::2])
    # 0.1 s before the first frame, and early by the time offset.
    assert stamps["/imu"][0] - images[0] == -110_000_000


def test_an_imu_at_rest_is_written_like_any_other_and_has_its_noise(tmp_path: Path) -> None:
    config = make_board_config({})
    recording = record_rest(config.imu, 1_700_000_000 * 10**9, 30.0, 5)
    rig = make_rig(config, 5)
    with BagWriter(tmp_path / "fast", rig, config.imu, False, False, with_camera=False) as bag:
        bag.add_imu_recording(recording)
    with BagWriter(tmp_path / "slow", rig, config.imu, False, False, with_camera=False) as bag:
        for sample in recording:
            bag.add_imu(sample)
    assert (tmp_path / "fast" / "fast.mcap").read_bytes() == (tmp_path / "slow" / "slow.mcap").read_bytes().replace(
        b"slow.mcap", b"fast.mcap"
    )
    white = (recording.accel - recording.accel_bias).std(axis=0) / np.sqrt(200)
    np.testing.assert_allclose(white, config.imu.accelerometer_noise_density, rtol=0.04)
    assert np.linalg.norm((recording.accel - recording.accel_bias).mean(axis=0)) == pytest.approx(9.81, abs=1e-3)
    walk = np.diff(recording.gyro_bias, axis=0).std(axis=0) * np.sqrt(200)
    np.testing.assert_allclose(walk, config.imu.gyroscope_random_walk, rtol=0.04)


def test_sensors_vary_only_where_asked_and_the_drawing_has_no_misalignment() -> None:
    focal = {
        spread: np.std([_simulation(seed=seed, **{"board.vary_rig": spread}).rig.camera.fx for seed in range(6)])
        for spread in (False, True)
    }
    assert focal[True] > 2.5 * focal[False]
    first, second = (_simulation(seed=seed).drawing.document for seed in (0, 1))
    assert first == second
    assert first["cam0"]["T_cam_imu"][0][:3] == [0.0, -1.0, 0.0]


def test_parts_do_not_depend_on_each_other_or_on_the_number_of_workers(tmp_path: Path) -> None:
    tiny = ("--resolution", "160x120", "--images", "3", "--target", "chessboard:4x3:0.008", "--seed", "3")
    assert _run("--out", str(tmp_path / "one"), "--parts", "laser", "--workers", "1", *tiny) == 0
    assert _run("--out", str(tmp_path / "two"), "--parts", "camera", "laser", "--workers", "2", *tiny) == 0
    for path in (tmp_path / "one" / "laser").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / "laser" / path.name).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (("--target", "chessboard:9x6:0.05"), SimulationError, "choose a --target with smaller squares"),
        (("--target", "chessboard:9x6:0.0003"), SimulationError, "choose a --target with fewer and larger squares"),
        (("--target", "circles:9x6:0.005"), InputError, "unknown kind 'circles'"),
        (("--images", "1"), VliError, "'board.images' is '1', expected 3 to 1000"),
        (("--time-offset", "2"), VliError, "'board.time_offset_s' is '2.0'"),
        (("--set", "board.imges=3"), VliError, "did you mean 'board.images'"),
        (("--seed", "-1"), SimulationError, "--seed '-1'"),
    ],
)
def test_impossible_boards_are_refused(tmp_path: Path, arguments: tuple[str, ...], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        _run("--out", str(tmp_path / "out"), "--parts", "camera", *arguments)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_directory_is_kept(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(OutputError, match="is not empty"):
        _run("--out", str(tmp_path))
