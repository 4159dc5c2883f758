"""What `vli replay` hears: losses counted, its own poses among them; the driver waits until it hears."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vli_bringup.graph import STAGES, Playback, describe_graph
from vli_bringup.listener import LISTENER, GraphListener
from vli_bringup.recorder import Recorder
from vli_common.calibration import load_calibration
from vli_common.geometry import pose
from vli_common.messages import odometry_to_message, pose_to_message
from vli_common.status import Health, NodeState, StageStatus
from vli_common.types import PoseEstimate


@pytest.fixture
def listener(repository: Path) -> GraphListener:
    calibration = load_calibration(repository / "bags/demo/calibration.yaml")
    return GraphListener(calibration)


def status(node: str, **values: int) -> StageStatus:
    named = {name.replace("__", "."): str(value) for name, value in values.items()}
    return StageStatus(0, node, Health.OK, NodeState.READY, "", named)


def test_messages_lost_on_the_way_and_dropped_by_a_node_are_counted(listener: GraphListener) -> None:
    listener.statuses["demux_node"] = status("demux_node", sent__image_long=10)
    listener.statuses["mapping_node"] = status("mapping_node", received__image_long=7, dropped__image_long=2)
    assert listener.losses() == {"mapping_node.image_long": 5}


def test_what_a_status_says_need_not_be_a_number(listener: GraphListener) -> None:
    values = {"sent.image_long": "many", "position_ns": "1e999", "received.image_long": "", "node.x": "-"}
    listener.statuses["demux_node"] = StageStatus(0, "demux_node", Health.OK, NodeState.READY, "", values)
    assert listener.losses() == {}
    assert listener.value("demux_node", "position_ns") == 0


def test_poses_that_never_reached_the_recorder_are_counted(listener: GraphListener) -> None:
    listener.statuses["backend_node"] = status("backend_node", sent__pose=3, sent__window=0)
    assert listener.losses() == {f"{LISTENER}.pose": 3}


def test_the_driver_waits_for_the_stages_and_for_who_records_them() -> None:
    driver = describe_graph(Path("c.yaml"), playback=Playback(Path("bag")), audience=LISTENER)[0]
    assert driver.parameters["wait_for"].split(",") == [*(name for _, name in STAGES), LISTENER]
    alone = describe_graph(Path("c.yaml"), playback=Playback(Path("bag")))[0]
    assert LISTENER not in alone.parameters["wait_for"]


def test_a_pose_is_recorded_with_the_covariance_of_its_odometry_whichever_comes_first(
    listener: GraphListener, repository: Path
) -> None:
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    T_map_imu, T_map_odom = pose(rotation, np.array([0.1, 0.2, 0.3])), pose(rotation.T, np.array([1.0, 0.0, 0.0]))
    covariance = np.diag([1e-6, 2e-6, 3e-6, 4e-6, 5e-6, 6e-6])
    estimates = [PoseEstimate(stamp, T_map_imu, T_map_odom, np.zeros(3), np.zeros(3), covariance) for stamp in (10, 20, 30)]
    direct = Recorder(load_calibration(repository / "bags/demo/calibration.yaml"))
    for estimate in estimates[:2]:
        direct.add_pose(estimate.stamp_ns, T_map_imu, covariance)
    info = {"received_timestamp": 0, "source_timestamp": 0}
    listener._on_pose(pose_to_message(estimates[0]), info)
    listener._on_odometry(odometry_to_message(estimates[0]))
    listener._on_odometry(odometry_to_message(estimates[1]))
    listener._on_pose(pose_to_message(estimates[1]), info)
    listener._on_pose(pose_to_message(estimates[2]), info)
    recorder = listener.sessions.recorder
    assert list(recorder.live) == [10, 20, 30]
    assert list(recorder.covariances) == [10, 20]
    np.testing.assert_allclose(recorder.covariances[20], direct.covariances[20], atol=1e-15)
