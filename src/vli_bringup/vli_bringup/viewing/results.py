"""What ``vli run`` and ``vli replay`` leave behind: map, trajectories, figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from vli_bringup.export import read_map
from vli_bringup.output import SUMMARY
from vli_bringup.tum import Trajectory, read_tum
from vli_bringup.viewing.map_display import MapDisplay
from vli_bringup.viewing.scene import Rgb, Scene
from vli_common.errors import InputError
from vli_common.types import PointCloud

_TRAJECTORIES: dict[str, tuple[str, Rgb]] = {
    "live": ("trajectory.tum", (230, 120, 20)),
    "final": ("trajectory_final.tum", (30, 110, 220)),
}
_CAMERAS = 100
_FIGURES = {
    "frames_long": "long frames",
    "keyframes": "keyframes",
    "points": "map points",
    "realtime_factor": "bag seconds a second",
    "ms_per_frame_mean": "ms a long frame",
}


def show_results(scene: Scene, path: Path) -> PointCloud:
    """Show the results in a directory, or a map file alone; return the map.

    Raises:
        InputError: there is no map, or a file is broken.
    """
    cloud = read_map(path)
    display = MapDisplay(scene)
    display.show(cloud)
    trajectories = _read_trajectories(path) if path.is_dir() else {}
    if trajectories:
        with scene.gui.add_folder("Trajectory"):
            for name, trajectory in trajectories.items():
                _add_trajectory(scene, name, trajectory)
    if path.is_dir() and (path / SUMMARY).is_file():
        scene.gui.add_markdown(figures_text(path / SUMMARY))
    scene.look_at(cloud.points)
    return cloud


def figures_text(path: Path) -> str:
    """Return what a ``summary.json`` says, as a list in Markdown.

    Raises:
        InputError: it is none.
    """
    try:
        summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        lines = [f"- {text}: {summary[name]:,}" for name, text in _FIGURES.items() if summary.get(name) is not None]
        states = [f"- {stamp:.2f} s: {state}: {reason}" for stamp, state, reason in summary.get("states", [])]
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"'{path}' is no summary of a run ({error})") from error
    return "\n".join([*lines, "", "States:", *states])


def _read_trajectories(directory: Path) -> dict[str, Trajectory]:
    paths = {name: directory / file for name, (file, _) in _TRAJECTORIES.items()}
    return {name: read_tum(path) for name, path in paths.items() if path.is_file() and path.stat().st_size}


def _add_trajectory(scene: Scene, name: str, trajectory: Trajectory) -> None:
    """Add the path and up to a hundred cameras along it, each with a switch; of the live one the cameras are off at first."""
    colour = _TRAJECTORIES[name][1]
    step = -(-len(trajectory) // _CAMERAS)
    _add_switch(scene, f"{name} path", scene.path(f"/{name}/path", trajectory.positions, colour), True)
    cameras = scene.cameras(f"/{name}/cameras", trajectory.poses[::step], colour)
    _add_switch(scene, f"{name} cameras", cameras, name == "final")


def _add_switch(scene: Scene, label: str, handle: Any, visible: bool) -> None:
    switch = scene.gui.add_checkbox(label, visible)
    handle.visible = visible

    def follow(_: object) -> None:
        handle.visible = switch.value

    switch.on_update(follow)
