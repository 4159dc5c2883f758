"""A scene in a browser: clouds, paths and cameras in metres, and a panel of controls beside it."""

from __future__ import annotations

import webbrowser
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import numpy as np

from vli_common.arrays import ByteArray, Float32Array, FloatArray
from vli_mapping.optional import optional

HOST = "127.0.0.1"
Rgb = tuple[int, int, int]

_NEAR_M, _FAR_M = 5e-4, 20.0
_LINE_PX = 2.0
_CELL_M, _SECTION_M = 0.01, 0.1
_FRUSTUM = np.array([[0, 0, 0], [-1, -0.75, 1.6], [1, -0.75, 1.6], [1, 0.75, 1.6], [-1, 0.75, 1.6]])
_EDGES = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
_FRUSTUM_M = 2e-3
_LEAST_EXTENT_M = 0.02
_ASIDE = np.array([0.25, -0.5, 0.5])
"""From the middle of the map to the eye, in extents of the map."""


class Scene:
    """A server of one scene; a context manager, whose end stops it.

    Args:
        title: of the panel.
        port: to listen at, or the next one that is free.

    Raises:
        OutputError: viser is not installed.
    """

    def __init__(self, title: str, port: int) -> None:
        viser = optional("viser", "view", "vli_bringup")
        # What it says would stand between the results on standard output.
        with redirect_stdout(StringIO()):
            self.server: Any = viser.ViserServer(host=HOST, port=port, label=title, verbose=False)
        # The button would offer the scene to the whole network through a relay of viser's.
        self.server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="large")
        self.server.scene.set_up_direction("+z")
        self.server.initial_camera.near, self.server.initial_camera.far = _NEAR_M, _FAR_M

    def __enter__(self) -> Scene:
        """Return the scene."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the server."""
        with redirect_stdout(StringIO()):
            self.server.stop()

    @property
    def gui(self) -> Any:
        """The panel of controls, as viser has it."""
        return self.server.gui

    @property
    def url(self) -> str:
        """Where a browser of this machine finds the scene."""
        return f"http://{HOST}:{self.server.get_port()}"

    def open_browser(self) -> None:
        """Show the scene in the browser of this desktop, if there is one."""
        webbrowser.open(self.url)

    def cloud(self, name: str, points: Float32Array | FloatArray, colours: ByteArray | Rgb, size_m: float) -> Any:
        """Add points (N, 3) in the place of those of the same name; return viser's handle."""
        return self.server.scene.add_point_cloud(
            name, points, colours, point_size=size_m, point_shape="circle", precision="float32", point_shading="flat"
        )

    def path(self, name: str, positions: FloatArray, colour: Rgb) -> Any:
        """Add a line through positions (N, 3)."""
        return self._lines(name, np.stack([positions[:-1], positions[1:]], axis=1), colour)

    def cameras(self, name: str, poses: FloatArray, colour: Rgb, size_m: float = _FRUSTUM_M) -> Any:
        """Add a frustum for each of ``T_map_camera`` (N, 4, 4)."""
        corners = (size_m * _FRUSTUM) @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
        return self._lines(name, corners[:, _EDGES].reshape(-1, 2, 3), colour)

    def look_at(self, points: Float32Array | FloatArray, move: bool = True) -> None:
        """Show all of the points (N, 3) from above and aside, above a grid of centimetres.

        Args:
            points: of a map.
            move: False leaves the eye of browsers that are there where it is: this is for those that come.
        """
        if not len(points):
            return
        low, high = np.percentile(points, [1, 99], axis=0)
        centre, extent = (low + high) / 2, max(float(np.linalg.norm(high - low)), _LEAST_EXTENT_M)
        self.view_from(centre + extent * _ASIDE, centre, move)
        self.server.scene.add_grid(
            "/grid",
            width=4 * extent,
            height=4 * extent,
            cell_size=_CELL_M,
            section_size=_SECTION_M,
            position=(centre[0], centre[1], low[2] - 0.05 * extent),
        )

    def view_from(self, position: FloatArray, target: FloatArray, move: bool = True) -> None:
        """Place the eye of the browsers that come and, to ``move`` them, of those that are there."""
        self.server.initial_camera.position, self.server.initial_camera.look_at = position, target
        for client in self.server.get_clients().values() if move else ():
            client.camera.position, client.camera.look_at = position, target

    def _lines(self, name: str, segments: FloatArray, colour: Rgb) -> Any:
        """Add line segments (N, 2, 3)."""
        return self.server.scene.add_line_segments(
            name, segments.astype(np.float32), colour, thickness=_LINE_PX, thickness_units="screen"
        )
