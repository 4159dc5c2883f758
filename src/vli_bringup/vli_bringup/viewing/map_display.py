"""A map in the scene, and the controls of how it looks."""

from __future__ import annotations

from typing import Any

from vli_bringup.viewing.colouring import COLOURINGS
from vli_bringup.viewing.scene import Scene
from vli_common.types import PointCloud

NAME = "/map"
_SIZE_MM, _LEAST_MM, _MOST_MM, _STEP_MM = 0.2, 0.02, 2.0, 0.02
_MM = 1e-3


class MapDisplay:
    """Shows one cloud, coloured as chosen; a further one takes its place.

    Args:
        scene: to show it in.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._cloud: PointCloud | None = None
        self._handle: Any = None
        with scene.gui.add_folder("Map"):
            self._count = scene.gui.add_markdown("no points yet")
            self.visible = scene.gui.add_checkbox("show", True)
            self.colouring = scene.gui.add_dropdown("colour by", tuple(COLOURINGS))
            self.size_mm = scene.gui.add_slider("point size, mm", _LEAST_MM, _MOST_MM, _STEP_MM, _SIZE_MM)
        self.visible.on_update(lambda _: self._apply())
        self.colouring.on_update(lambda _: self._colour())
        self.size_mm.on_update(lambda _: self._apply())

    @property
    def size_m(self) -> float:
        """Size of a point as chosen."""
        return float(self.size_mm.value) * _MM

    def show(self, cloud: PointCloud) -> None:
        """Show a cloud in the place of the one before."""
        self._cloud = cloud
        self._handle = self._scene.cloud(NAME, cloud.points, COLOURINGS[self.colouring.value](cloud), self.size_m)
        self._count.content = f"{len(cloud):,} points"
        self._apply()

    def _apply(self) -> None:
        if self._handle is not None:
            self._handle.visible, self._handle.point_size = bool(self.visible.value), self.size_m

    def _colour(self) -> None:
        if self._handle is not None and self._cloud is not None:
            self._handle.colors = COLOURINGS[self.colouring.value](self._cloud)
