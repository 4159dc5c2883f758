"""What mapping has saved by itself, and where it goes when the graph is left."""

from __future__ import annotations

from pathlib import Path

import pytest
from mapping_scenes import sheet

from vli_bringup.graph_run import _fall_back, _put_away_saves
from vli_bringup.settings import Settings
from vli_mapping.map_file import load_map, map_origin, save_map, session_origin
from vli_mapping.point_map import PointMap
from vli_mapping.snapshot import Snapshot, view

ROWS = 6


def save(path: Path, session: int | None) -> None:
    """Write a small map of a session."""
    made = PointMap()
    sheet(made, ROWS)
    whole = view(made, None)
    origin = "" if session is None else session_origin(session, "backend_node 7")
    save_map(path, Snapshot(whole.columns, whole.views, None, origin))


def names(directory: Path) -> list[str]:
    return sorted(str(path.relative_to(directory)) for path in directory.rglob("*.vli"))


@pytest.mark.parametrize(("of", "taken"), [(2, True), (None, True), (1, False)])
def test_the_last_save_stands_in_for_a_map_that_was_not_saved_unless_it_is_of_an_earlier_session(
    tmp_path: Path, of: int | None, taken: bool
) -> None:
    save(tmp_path / "autosave.vli", of)
    _fall_back(tmp_path, 2)
    assert names(tmp_path) == ["map.vli" if taken else "autosave.vli"]


def test_a_map_that_was_saved_is_not_replaced_and_its_save_goes(tmp_path: Path) -> None:
    save(tmp_path / "map.vli", None)
    save(tmp_path / "autosave.vli", 2)
    _fall_back(tmp_path, 2)
    _put_away_saves(tmp_path, 2, {}, Settings())
    assert names(tmp_path) == ["map.vli"]
    assert map_origin(tmp_path / "map.vli") == ""


@pytest.mark.parametrize("last_has_map", [True, False])
def test_an_earlier_session_whose_map_was_not_kept_in_time_gets_the_last_save_of_it(tmp_path: Path, last_has_map: bool) -> None:
    if last_has_map:
        save(tmp_path / "map.vli", 3)
    for number in (1, 2):
        (tmp_path / f"session-{number}").mkdir()
    save(tmp_path / "autosave_session-1.vli", None)
    save(tmp_path / "autosave.vli", 2)
    _fall_back(tmp_path, 3)
    _put_away_saves(tmp_path, 3, {1: tmp_path / "session-1", 2: tmp_path / "session-2"}, Settings())
    last = ["map.vli"] if last_has_map else []
    assert names(tmp_path) == [*last, "session-1/map.vli", "session-2/map.vli"]
    assert map_origin(tmp_path / "session-2/map.vli").startswith("session 2 of")
    assert (tmp_path / "session-2" / "map.ply").exists()
    assert len(load_map(tmp_path / "session-1/map.vli")) == ROWS**2
