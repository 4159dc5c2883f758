"""The mapping node under overload, and cut off: what waits for its worker, and what does not come."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from mapping_scenes import sheet, stripe
from patience import wait
from rclpy.parameter import Parameter

from vli_common.calibration import Calibration, load_calibration
from vli_common.messages import Session, image_to_cdr, scan_to_message, status_to_message
from vli_common.node import inputs
from vli_common.status import Health, NodeState, StageStatus
from vli_common.topics import IMAGE_LONG, LASER_POINTS, MAP, STATUS
from vli_common.types import Counters, Image, LaserScan
from vli_mapping.map_file import load_map, save_map
from vli_mapping.nodes.mapping_node import MappingNode
from vli_mapping.snapshot import take

BEHIND_S = 8
LONG_HZ = 30


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[MappingNode]:
    """Return a node whose worker has not begun: everything waits."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init(args=[])
    item = MappingNode()
    yield item
    item.destroy_node()
    rclpy.try_shutdown()


def dropped(node: MappingNode) -> dict[str, str]:
    node.publish_status()
    values = node.others["mapping_node"].values
    return {name: value for name, value in values.items() if name.startswith(("dropped.", "waiting."))}


def callback(node: MappingNode, topic: str):
    (found,) = (item.callback for item in node.subscriptions if item.topic_name.endswith(f"/{topic}"))
    return found


def test_a_mapper_that_is_eight_seconds_behind_loses_no_colour(node):
    receive = callback(node, IMAGE_LONG.name)
    for stamp_ns in range(BEHIND_S * LONG_HZ):
        receive(image_to_cdr(Image(stamp_ns, np.zeros((4, 4, 3), np.uint8))))
    values = dropped(node)
    assert values["waiting.image_long"] == str(BEHIND_S * LONG_HZ)
    assert "dropped.image_long" not in values


def test_what_waits_is_bounded_and_what_goes_is_counted(node):
    receive = callback(node, LASER_POINTS.name)
    for stamp_ns in range(500):
        receive(scan_to_message(LaserScan.empty(stamp_ns)))
    values = dropped(node)
    assert int(values["waiting.laser_points"]) + int(values["dropped.laser_points"]) == 500
    assert int(values["waiting.laser_points"]) == 12 * LASER_POINTS.depth


def test_a_node_that_hears_nothing_of_what_another_sends_says_so_until_it_does(node, monkeypatch):
    now_s = 1000.0
    monkeypatch.setattr(inputs.time, "monotonic", lambda: now_s)
    node.set_state(NodeState.READY)
    say, said = callback(node, STATUS.name), []
    for second in range(10):
        now_s += 1.0
        values = {"session": "0", f"sent.{LASER_POINTS.name}": str(30 * second)}
        say(status_to_message(StageStatus(second, "demux_node", Health.OK, NodeState.READY, "", values)))
        if second == 8:
            callback(node, LASER_POINTS.name)(scan_to_message(LaserScan.empty(second)))
        node.publish_status()
        said.append(node.others["mapping_node"])
    assert [status.health for status in said] == [Health.OK] * 6 + [Health.WARN] * 3 + [Health.OK]
    assert said[7].hint == (
        "cut off: nothing has come of 210 messages of 'demux_node' on 'laser_points'; start this node again, else that one"
    )
    assert "cut off" not in said[-1].hint


def test_a_node_whose_stage_has_failed_leaves_the_last_save_as_it_is(saving, tmp_path):
    saving._is_resumed = True
    sheet(saving.mapper.map)
    assert saving._has_more
    saving.fail(RuntimeError("broken"))
    assert saving.close()
    assert files(tmp_path) == []


@pytest.mark.parametrize(("points", "saves"), [(1, ["under way", "last"]), (0, ["under way"])])
def test_a_node_that_is_stopped_lets_an_automatic_save_end_and_saves_what_came_since(node, monkeypatch, points, saves):
    done = []
    monkeypatch.setattr(node, "_autosave", lambda: done.append("last"))
    assert node.set_parameters([Parameter("autosave_s", value=60.0)])[0].successful
    node._mapper, node._is_resumed = SimpleNamespace(map=[0.0] * points, session=1, counters=Counters()), True
    assert node._saving.acquire(blocking=False)

    def end() -> None:
        done.append("under way")
        node._saving.release()

    timer = threading.Timer(0.2, end)
    timer.start()
    assert node.close()
    timer.join()
    assert done == saves


def test_the_light_is_found_beside_the_worker_and_the_map_published_after_it(node, monkeypatch):
    under_way, go_on, done = threading.Event(), threading.Event(), []

    def fit() -> None:
        under_way.set()
        assert go_on.wait(10.0)
        done.append(threading.current_thread() is threading.main_thread())

    monkeypatch.setattr(node, "call", lambda job: job())
    monkeypatch.setattr(node, "enqueue", lambda job: done.append(job.__name__))
    monkeypatch.setattr(node, "has_listener", lambda topic: topic is MAP)
    node._mapper = SimpleNamespace(light_fit=lambda: fit, map=[])
    for _ in range(3):
        node._look_after_map()
    assert under_way.wait(10.0)
    assert not done
    go_on.set()
    assert node._lighting.acquire(timeout=10.0)
    assert done == [False, "_publish_map"]


def test_where_nobody_looks_no_light_is_sought(node, monkeypatch):
    monkeypatch.setattr(node, "has_listener", lambda _: False)
    node._mapper = SimpleNamespace(map=[])
    node._look_after_map()
    assert not node._lighting.locked()


@pytest.fixture
def calibration(repository: Path) -> Calibration:
    return load_calibration(repository / "bags/demo/calibration.yaml")


@pytest.fixture
def saving(node: MappingNode, calibration: Calibration, tmp_path: Path) -> MappingNode:
    """Return a node that saves by itself, ready, in session 3."""
    values = {"autosave_s": 60.0, "autosave_path": str(tmp_path / "auto.vli")}
    assert all(item.successful for item in node.set_parameters([Parameter(name, value=value) for name, value in values.items()]))
    node.create_stage(calibration)
    node.on_session(Session(3, "start"))
    return node


def files(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def test_the_map_of_a_session_that_ends_is_kept_whole_and_the_next_begins_empty(saving, tmp_path):
    sheet(saving.mapper.map)
    points = len(saving.mapper.map)
    saving.on_session(Session(4, "the clock jumped"))
    assert not len(saving.mapper.map)
    kept = tmp_path / "auto_session-3.vli"
    wait(kept.exists)
    assert saving.close()
    assert len(load_map(kept)) == points
    assert files(tmp_path) == [kept.name]


@pytest.mark.parametrize(("of", "left"), [(3, []), (4, ["auto.vli"])])
def test_what_was_saved_of_a_session_that_ends_goes_and_what_is_of_the_next_stays(saving, tmp_path, of, left):
    sheet(saving.mapper.map)
    save_map(tmp_path / "auto.vli", replace(take(saving.mapper.map, None), origin=f"session {of} of backend_node 77"))
    saving.on_session(Session(4, "the clock jumped"))
    assert saving.close()
    assert files(tmp_path) == [*left, "auto_session-3.vli"]


def test_scans_of_the_window_that_ends_with_its_session_are_kept_too(saving, monkeypatch, tmp_path):
    x = 3e-4 * np.arange(40)
    left = [stripe(np.stack([x, np.full_like(x, 3e-4 * row), np.zeros_like(x)], axis=1), row) for row in range(20)]
    monkeypatch.setattr(saving.mapper, "waiting", lambda: left)
    saving.on_session(Session(4, "the clock jumped"))
    assert saving.close()
    assert len(load_map(tmp_path / "auto_session-3.vli")) > 0
    assert not len(saving.mapper.map)


def test_parameters_that_take_effect_with_a_new_session_do_not_cost_the_map_before_it(saving, calibration, tmp_path):
    sheet(saving.mapper.map)
    saving.create_stage(calibration)
    saving.on_session(Session(4, "reset"))
    assert saving.close()
    assert files(tmp_path) == ["auto_session-3.vli"]


def test_a_session_in_which_nothing_was_mapped_leaves_no_file(saving, tmp_path):
    saving.on_session(Session(4, "reset"))
    assert saving.close()
    assert files(tmp_path) == []


def test_without_automatic_saves_a_session_that_ends_leaves_no_file(saving, tmp_path):
    assert saving.set_parameters([Parameter("autosave_s", value=0.0)])[0].successful
    sheet(saving.mapper.map)
    saving.on_session(Session(4, "reset"))
    assert saving.close()
    assert files(tmp_path) == []


def test_a_map_that_has_not_changed_since_is_not_saved_again(saving, monkeypatch, tmp_path):
    monkeypatch.setattr(saving, "call", lambda job: job())
    sheet(saving.mapper.map)
    assert saving._has_more
    assert saving._save_all(tmp_path / "map.vli") == len(saving.mapper.map)
    assert not saving._has_more
    sheet(saving.mapper.map, first_number=100)
    saving.mapper.counters.add("scans_entered")
    assert saving._has_more
