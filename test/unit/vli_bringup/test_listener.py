"""What `vli replay` hears: losses counted, its own poses among them; the driver waits until it hears."""

from __future__ import annotations

from pathlib import Path

import pytest

from vli_bringup.graph import STAGES, Playback, describe_graph
from vli_bringup.listener import LISTENER, GraphListener
from vli_bringup.recorder import Recorder
from vli_common.calibration import load_calibration
from vli_common.status import Health, NodeState, StageStatus


@pytest.fixture
def listener(repository: Path) -> GraphListener:
    calibration = load_calibration(repository / "bags/demo/calibration.yaml")
    return GraphListener(Recorder(calibration))


def status(node: str, **values: int) -> StageStatus:
    named = {name.replace("__", "."): str(value) for name, value in values.items()}
    return StageStatus(0, node, Health.OK, NodeState.READY, "", named)


def test_messages_lost_on_the_way_and_dropped_by_a_node_are_counted(listener: GraphListener) -> None:
    listener.statuses["demux_node"] = status("demux_node", sent__image_long=10)
    listener.statuses["mapping_node"] = status("mapping_node", received__image_long=7, dropped__image_long=2)
    assert listener.losses() == {"mapping_node.image_long": 5}


def test_poses_that_never_reached_the_recorder_are_counted(listener: GraphListener) -> None:
    listener.statuses["backend_node"] = status("backend_node", sent__pose=3, sent__window=0)
    assert listener.losses() == {f"{LISTENER}.pose": 3}


def test_the_driver_waits_for_the_stages_and_for_who_records_them() -> None:
    driver = describe_graph(Path("c.yaml"), playback=Playback(Path("bag")), audience=LISTENER)[0]
    assert driver.parameters["wait_for"].split(",") == [*(name for _, name in STAGES), LISTENER]
    alone = describe_graph(Path("c.yaml"), playback=Playback(Path("bag")))[0]
    assert LISTENER not in alone.parameters["wait_for"]
