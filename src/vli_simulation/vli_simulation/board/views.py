"""From where a board is looked at: poses that a careful person would choose, drawn at random."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vli_calibration.targets import AprilGrid, Chessboard, Target
from vli_common.arrays import BoolArray, FloatArray
from vli_common.geometry import pose, so3_exp, transform
from vli_simulation.config import SimulationError
from vli_simulation.rig import Rig

_BORDER_PX = 6.0
_TRIES = 4000
_CELLS = 3
_SMALLEST_PX = {Chessboard: 8.0, AprilGrid: 24.0}
_SMALLEST_MARKER_PX = 18.0
"""Least size in the image of a square, or tag, that a detector can be asked to find."""
_PARTLY_SEEN = 0.6
_GRAZING = 0.3


@dataclass(frozen=True)
class ViewPlanner:
    """Draws poses of a board before a rig's camera.

    Args:
        target: the board.
        rig: the instrument.
        tilt: largest angle between the board's normal and the camera's axis, radians.
    """

    target: Target
    rig: Rig
    tilt: float

    @cached_property
    def reach(self) -> tuple[float, float]:
        """Distances (near, far), metres, between which the board can be found in an image.

        Raises:
            SimulationError: the board is too large, or its squares are too small, for the instrument's range.
        """
        camera, (first, last) = self.rig.camera, self.rig.document["laser0"]["range_m"]
        steps = np.geomspace(0.2 * first, 20 * last, 200)
        fits = [bool(self._seen(pose(np.eye(3), self._centre_at(np.array([0.0, 0.0, z])))).mean() >= self._share) for z in steps]
        nearest = float(steps[np.argmax(fits)]) if any(fits) else np.inf
        farthest = min(last, self.target.spacing * camera.focal_px / self._smallest_px)
        near = max(first, 1.08 * nearest)
        if near > 0.85 * farthest:
            x0, y0, x1, y1 = self.target.extent
            size = f"{1e3 * (x1 - x0):.0f} × {1e3 * (y1 - y0):.0f} mm"
            advice = "smaller squares" if nearest > 0.7 * last else "fewer and larger squares"
            raise SimulationError(
                f"target '{self.target.spec}' of {size} is in view from {1e3 * near:.0f} mm on and its squares can be told up to "
                f"{1e3 * farthest:.0f} mm, expected both within {1e3 * first:.0f} to {1e3 * last:.0f} mm; "
                f"choose a --target with {advice}"
            )
        return near, farthest

    def camera_views(self, count: int, rng: np.random.Generator) -> list[FloatArray]:
        """Return T_cam_board of views that together cover the image, tilted and not, near and far."""
        near, far = self.reach
        far = min(far, 2.4 * near)
        camera = self.rig.camera

        def draw(index: int, share: float) -> FloatArray:
            cell = np.array([index % _CELLS, index // _CELLS % _CELLS]) + rng.uniform(0, 1, 2)
            # The cell is a wish: what a large board cannot reach, it comes near to.
            at = np.array([camera.cx, camera.cy]) + (1 - share) * (
                cell / _CELLS * [camera.width, camera.height] - [camera.cx, camera.cy]
            )
            ray = np.append(camera.unproject(at[None])[0], 1.0)
            return self._posed(rng, rng.uniform(near, far) * ray, self._middle)

        return [self._first_good(draw, index, "images for the camera") for index in range(count)]

    def laser_views(self, count: int, rng: np.random.Generator) -> list[FloatArray]:
        """Return T_cam_board of views in which the stripe crosses the board, spread over the distances."""
        near, far = self.reach
        x0, y0, x1, y1 = self.target.extent

        def draw(index: int, share: float) -> FloatArray:
            depth = near * (far / near) ** ((index + rng.uniform(0, 1)) / count)
            depth = max(depth, near * (1 + 0.25 * share))
            on_board = self._middle + rng.uniform(-0.3, 0.3, 3) * np.array([x1 - x0, y1 - y0, 0.0])
            return self._posed(rng, self._on_sheet(depth, (1 - share) * rng.uniform(-0.3, 0.3)), on_board)

        return [self._first_good(draw, index, "images for the laser", self._is_cut) for index in range(count)]

    def stripe_views(self, count: int, rng: np.random.Generator) -> list[FloatArray]:
        """Return T_cam_board of views of the board's plane in which the stripe is seen, over the whole range."""
        first, last = self.rig.document["laser0"]["range_m"]
        depths = np.geomspace(1.2 * first, 0.95 * last, count)
        places = rng.uniform(-0.05, 0.05, (count, 3)) * np.array([1.0, 1.0, 0.0])
        return [
            self._posed(rng, self._on_sheet(float(depth), rng.uniform(-0.2, 0.2)), self._middle + place)
            for depth, place in zip(depths, places, strict=True)
        ]

    @property
    def _middle(self) -> FloatArray:
        x0, y0, x1, y1 = self.target.extent
        return np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0])

    @cached_property
    def _limits(self) -> FloatArray:
        """Largest |x/z| and |y/z| that the image shows."""
        camera = self.rig.camera
        result: FloatArray = np.abs(camera.unproject(camera.pixel_grid(9))).max(axis=0)
        return result

    @property
    def _smallest_px(self) -> float:
        return _SMALLEST_PX.get(type(self.target), _SMALLEST_MARKER_PX)

    @cached_property
    def _looked_for(self) -> FloatArray:
        """Points (N, 3) of the board that should be in the image: of a chessboard, its outer squares too."""
        if not isinstance(self.target, Chessboard):
            return self.target.points
        x0, y0, x1, y1 = self.target.extent
        return np.vstack([self.target.points, [[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]]])

    @property
    def _share(self) -> float:
        """Share of the corners that must be in the image: a chessboard is found whole or not at all."""
        return 1.0 if isinstance(self.target, Chessboard) else _PARTLY_SEEN

    def _centre_at(self, point: FloatArray) -> FloatArray:
        return point - self._middle

    def _posed(self, rng: np.random.Generator, point: FloatArray, on_board: FloatArray) -> FloatArray:
        """Return T_cam_board with a point of the board (3,) at ``point`` (3,) of the camera frame, turned at random."""
        azimuth, tilt = rng.uniform(-np.pi, np.pi), self.tilt * np.sqrt(rng.uniform(0, 1))
        roll = rng.uniform(-np.pi, np.pi) if not self.target.symmetric else rng.uniform(-0.45 * np.pi, 0.45 * np.pi)
        rotation = so3_exp(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])) @ so3_exp(np.array([0.0, 0.0, roll]))
        return pose(rotation, point - rotation @ on_board)

    def _first_good(
        self,
        draw: Callable[[int, float], FloatArray],
        index: int,
        what: str,
        also: Callable[[FloatArray], bool] = lambda _: True,
    ) -> FloatArray:
        """Return the first of the poses drawn in which the board can be found; wishes are given up little by little."""
        for attempt in range(_TRIES):
            T_cam_board = draw(index, min(attempt / (0.5 * _TRIES), 1.0))
            if self._can_be_found(T_cam_board) and also(T_cam_board):
                return T_cam_board
        raise SimulationError(
            f"no view of '{self.target.spec}' tilted by up to '{np.rad2deg(self.tilt):.0f}' degrees found for {what}; "
            "choose smaller squares or less board.tilt_deg"
        )

    def _can_be_found(self, T_cam_board: FloatArray) -> bool:
        corners = transform(T_cam_board, self.target.points)
        if corners[:, 2].min() < 2e-3:
            return False
        incidence = corners @ T_cam_board[:3, 2] / np.linalg.norm(corners, axis=1)
        if incidence.min() < _GRAZING:
            return False
        # Tilted squares are foreshortened.
        size = self.target.spacing * self.rig.camera.focal_px * float((incidence / corners[:, 2]).min())
        return bool(size >= 0.8 * self._smallest_px and self._seen(T_cam_board).mean() >= self._share)

    def _seen(self, T_cam_board: FloatArray) -> BoolArray:
        """Return for each point that is looked for (N,) whether it is in the image."""
        camera = self.rig.camera
        corners = transform(T_cam_board, self._looked_for)
        with np.errstate(invalid="ignore"):
            pixels = camera.project(corners)
            inside = (pixels > _BORDER_PX) & (pixels < np.array([camera.width, camera.height]) - 1 - _BORDER_PX)
        # Far outside the image the polynomial of the lens folds back into it: angles tell.
        with np.errstate(divide="ignore", invalid="ignore"):
            near = np.abs(corners[:, :2] / corners[:, 2:]) <= self._limits
        result: BoolArray = np.all(inside & near, axis=1) & (corners[:, 2] > 0)
        return result

    def _on_sheet(self, depth: float, aside: float) -> FloatArray:
        """Return the point of the laser's plane at a depth, ``aside`` as a share of the depth along the stripe."""
        normal, d = self.rig.laser.normal, self.rig.laser.d
        nearest = -(d + normal[2] * depth) * normal[:2] / float(normal[:2] @ normal[:2])
        along = np.array([-normal[1], normal[0]]) / np.linalg.norm(normal[:2])
        return np.append(nearest + 2 * aside * depth * along, depth)

    def _is_cut(self, T_cam_board: FloatArray) -> bool:
        """Return whether the stripe is seen on the board over at least 40 % of its shorter side."""
        x0, y0, x1, y1 = self.target.extent
        normal = T_cam_board[:3, :3].T @ self.rig.laser.normal
        offset = float(self.rig.laser.normal @ T_cam_board[:3, 3] + self.rig.laser.d)
        square = float(normal[:2] @ normal[:2])
        if square < 1e-6:
            return False
        length = float(np.hypot(x1 - x0, y1 - y0))
        steps = np.linspace(-length, length, 401)
        middle = self._middle[:2] - (float(normal[:2] @ self._middle[:2]) + offset) * normal[:2] / square
        line = middle + steps[:, None] * np.array([-normal[1], normal[0]]) / np.sqrt(square)
        line = line[np.all((line >= [x0, y0]) & (line <= [x1, y1]), axis=1)]
        if not len(line):
            return False
        points = transform(T_cam_board, np.column_stack([line, np.zeros(len(line))]))
        camera = self.rig.camera
        with np.errstate(invalid="ignore"):
            pixels = camera.project(points)
            seen = np.all((pixels > 0) & (pixels < [camera.width - 1, camera.height - 1]), axis=1)
        return bool(np.count_nonzero(seen) * (steps[1] - steps[0]) > 0.4 * min(x1 - x0, y1 - y0))
