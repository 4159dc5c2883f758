"""The services of a graph that scans: nothing stops, and each file is what it says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from graph_tools import NODES, demo_graph, text, wait

from vli_bringup.listener import GraphListener
from vli_bringup.processes import NodeProcesses
from vli_common.calibration import load_calibration
from vli_common.status import NodeState
from vli_mapping.map_file import load_map, session_of

pytestmark = pytest.mark.graph

_MAPPING, _BACK_END, _DRIVER = "mapping_node", "backend_node", "driver_node"
_ANSWER_S = 60.0


def test_services_of_a_running_scan(repository: Path, tmp_path: Path, parameter_file: Path) -> None:
    demo = repository / "bags" / "demo"
    saved, mesh, autosaved = tmp_path / "map.vli", tmp_path / "mesh.ply", tmp_path / "autosave.vli"
    store = {
        "save_path": str(saved),
        "load_path": str(saved),
        "export_path": str(mesh),
        "autosave_s": 1.0,
        "autosave_path": str(autosaved),
    }
    nodes = demo_graph(demo, {_DRIVER: {"loop": True}, _MAPPING: store})
    listener = GraphListener(load_calibration(demo / "calibration.yaml"))
    with NodeProcesses(nodes, parameter_file) as processes, listener:
        wait(listener, lambda: listener.value(_MAPPING, "points") > 2000, processes=processes)
        # The driver is held: what follows is about one map, and the session does not end meanwhile.
        listener.call(f"{_DRIVER}/pause", _ANSWER_S)
        wait(listener, lambda: listener.state(_DRIVER) is NodeState.PAUSED)

        entered = listener.value(_MAPPING, "points")
        answer = listener.call(f"{_MAPPING}/save", _ANSWER_S)
        count = len(load_map(saved))
        assert answer == f"{count} points in '{saved}'"
        assert count > entered, "the scans that are still in the window are saved with the map"
        assert re.fullmatch(r"\d+ triangles in '.*mesh.ply'", listener.call(f"{_MAPPING}/export", _ANSWER_S))
        assert mesh.read_bytes().startswith(b"ply")

        listener.call(f"{_BACK_END}/pause", _ANSWER_S)
        wait(listener, lambda: listener.state(_BACK_END) is NodeState.PAUSED)
        wait(listener, lambda: listener.value(_MAPPING, "points") > entered)
        for name in (_BACK_END, _DRIVER):
            listener.call(f"{name}/resume", _ANSWER_S)
            wait(listener, lambda name=name: listener.state(name) is NodeState.READY)

        session = listener.value(_MAPPING, "session")
        listener.call("frontend_node/reset", _ANSWER_S)
        wait(listener, lambda: all(listener.value(name, "session") > session for name in NODES), processes=processes)
        assert listener.call(f"{_MAPPING}/clear", _ANSWER_S) == "the map is empty"
        assert listener.call(f"{_MAPPING}/load", _ANSWER_S).startswith(f"{count} points from '{saved}'")
        wait(listener, lambda: listener.value(_MAPPING, "points") >= count)

        kept = autosaved.with_stem(f"{autosaved.stem}_session-{session}")
        wait(listener, kept.exists, processes=processes)
        wait(listener, lambda: (session_of(autosaved) or 0) > session, processes=processes)
        assert min(len(load_map(kept)), len(load_map(autosaved))) > 0
        wait(listener, lambda: text(listener, _BACK_END, "tracking") == "TRACKING", processes=processes)
        assert processes.restarts == {}
