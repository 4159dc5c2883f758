"""The laser plane from images: stripe on boards, robust plane, hand–eye, joint refinement, and what the result is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from vli_calibration.board_pose import board_pose
from vli_calibration.boards import Target
from vli_calibration.bootstrap import simultaneous_half_widths
from vli_calibration.hand_eye import HandEye, solve_hand_eye
from vli_calibration.laser_joint import JointProblem, JointSolution, LaserView, solve_reduced
from vli_calibration.laser_model import LaserPlane, camera_parameters, stripe_points, stripe_sigmas, with_parameters
from vli_calibration.laser_scenes import LaserScene, corners, look_at, rejections, require_boards, require_stripes
from vli_calibration.laser_table import TableCheck, check_table, triangulated
from vli_calibration.plane_fit import ImagePoints, agreeing_images, fit_images, fit_plane_robust, spread
from vli_calibration.types import CalibrationImage, Rejection
from vli_common.arrays import BoolArray, FloatArray
from vli_common.camera import CameraModel
from vli_common.errors import InputError

LEAST_IMAGES = 4
"""A plane needs three stripes that are not on one line; a fourth tells whether they agree."""
LEAST_BOARDS_FOR_CAMERA = 8
"""Boards that it takes to refine the camera too; with fewer it stays as it is."""
_LEAST_SPREAD = 0.01
_NEAR, _FAR = 0.8, 1.25
_PLANE_NAMES = ("nx", "ny", "nz", "d")


@dataclass(frozen=True)
class StripeResidual:
    """One image's stripe after the joint solve.

    Args:
        name: of the image.
        pixels: (M, 2) raw.
        distances: (M,) signed, from the laser plane, metres.
        depths: (M,) z of the points, metres.
        kept: (M,) points that the solution rests on.
        loo_depth_errors: (M,) depth by the plane of all other images less the board's, metres; empty for a stripe without board.
    """

    name: str
    pixels: FloatArray
    distances: FloatArray
    depths: FloatArray
    kept: BoolArray
    loo_depth_errors: FloatArray


@dataclass(frozen=True)
class LaserFit:
    """The calibrated plane, and everything its report says.

    Args:
        plane: in the frame of ``camera``.
        camera: refined with it, or as given.
        camera_refined: whether it was.
        range_m: nearest and farthest depth to be trusted.
        half_widths: (4,) of intervals that hold n and d at once with 95 %.
        tilt_rad: the largest tilt within those intervals.
        residuals: of each image with a stripe that was used.
        rejected: images left out, with reasons.
        scenes: all images.
        along_columns, channel: of the stripe.
        points_total: stripe points found on boards, those of images left out too.
        points_used: of those, the ones the solution rests on.
        pnp_rms_m: RMS distance of all points of the used images from the plane fitted to fixed board poses.
        corner_rms_px: RMS reprojection error of the kept corners after the joint solve.
        solution: of the joint problem.
        hand_eye, table: where arm poses were given.
    """

    plane: LaserPlane
    camera: CameraModel
    camera_refined: bool
    range_m: tuple[float, float]
    half_widths: FloatArray
    tilt_rad: float
    residuals: tuple[StripeResidual, ...]
    rejected: tuple[Rejection, ...]
    scenes: tuple[LaserScene, ...]
    along_columns: bool
    channel: str
    points_total: int
    points_used: int
    pnp_rms_m: float
    corner_rms_px: float
    solution: JointSolution
    hand_eye: HandEye | None = None
    table: TableCheck | None = None

    @property
    def rms_m(self) -> float:
        """RMS distance of the kept points from the plane after the joint solve."""
        return _rms(np.concatenate([item.distances[item.kept] for item in self.residuals]))

    @property
    def loo_depth_errors(self) -> FloatArray:
        """(ΣM,) of all kept points."""
        parts = [item.loo_depth_errors[item.kept] for item in self.residuals if len(item.loo_depth_errors)]
        return np.concatenate(parts) if parts else np.empty(0)

    @property
    def loo_depth_rms_m(self) -> float:
        """RMS of the leave-one-image-out depth errors."""
        return _rms(self.loo_depth_errors)

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals of the plane's numbers, simultaneous: all four hold at once."""
        low, high = self.plane.vector - self.half_widths, self.plane.vector + self.half_widths
        return {name: (float(a), float(b)) for name, a, b in zip(_PLANE_NAMES, low, high, strict=True)}


@dataclass(frozen=True)
class LaserOptions:
    """Choices of the user.

    Args:
        refine_camera: False holds the camera as it is.
        camera_sigmas: (C,) how well the camera's parameters are known; None where the calibration does not say.
    """

    refine_camera: bool = True
    camera_sigmas: FloatArray | None = field(default=None)


def calibrate_laser(
    images: Sequence[CalibrationImage], target: Target, camera: CameraModel, options: LaserOptions | None = None
) -> LaserFit:
    """Return the laser plane.

    Raises:
        InputError: no boards or stripes, too few, views that do not determine the plane, or arm poses that do not fit.
    """
    scenes, finder = look_at(images, target, camera)
    require_boards(scenes, target)
    require_stripes(scenes, LEAST_IMAGES)
    arm = _hand_eye(scenes, target)
    views, rejected, pnp_rms = _agreeing_views(scenes, target, camera, finder.along_columns, arm)
    sigmas = _camera_sigmas(camera, views, options or LaserOptions())
    problem = JointProblem(views, finder.along_columns, sigmas)
    start = fit_plane_robust(np.concatenate([stripe_points(camera, view.T_cam_board, view.stripe) for view in views]))
    solution = problem.solve(camera, start)
    outputs = np.zeros((4, len(solution.free)))
    outputs[:, -3:] = solution.plane.vector_jacobian()
    half_widths = simultaneous_half_widths(solution.systems, outputs[:, solution.free])
    residuals = _residuals(views, solution)
    on_boards = {view.name for view in views if len(view.points)}
    return LaserFit(
        plane=solution.plane,
        camera=solution.camera,
        camera_refined=bool((sigmas > 0).any()),
        range_m=_range(residuals),
        half_widths=half_widths,
        tilt_rad=float(np.linalg.norm(half_widths[:3])),
        residuals=tuple(residuals),
        rejected=(*rejections(scenes), *rejected),
        scenes=tuple(scenes),
        along_columns=finder.along_columns,
        channel=finder.channel,
        points_total=sum(len(scene.stripe or ()) for scene in scenes if scene.board),
        points_used=int(sum(item.kept.sum() for item in residuals if item.name in on_boards)),
        pnp_rms_m=pnp_rms,
        corner_rms_px=problem.corner_rms_px(solution),
        solution=solution,
        hand_eye=arm,
        table=_table(scenes, solution, arm),
    )


def _hand_eye(scenes: Sequence[LaserScene], target: Target) -> HandEye | None:
    posed = [
        (scene.name, scene.image.T_base_tool, scene.board.T_cam_board)
        for scene in scenes
        if scene.board is not None and scene.image.T_base_tool is not None
    ]
    if not posed:
        return None
    names, tool, boards = zip(*posed, strict=True)
    turned = None
    if target.symmetric:
        turned = np.diag([-1.0, -1.0, 1.0, 1.0])
        turned[:2, 3] = 2 * target.points.mean(axis=0)[:2]
    return solve_hand_eye(names, np.stack(tool), np.stack(boards), turned)


def _agreeing_views(
    scenes: Sequence[LaserScene], target: Target, camera: CameraModel, along_columns: bool, arm: HandEye | None
) -> tuple[list[LaserView], list[Rejection], float]:
    """Return the views to solve with, the images left out because they disagree, and the RMS with fixed board poses, metres."""
    correlation = float(np.median([scene.stripe.correlation for scene in scenes if scene.stripe]))
    views = [view for scene in scenes if (view := _view(scene, target, correlation, arm)) is not None]
    points = _image_points(scenes, camera, along_columns, correlation)
    _check_spread(points)
    agreeing, out = agreeing_images(points, LEAST_IMAGES)
    reasons = [
        Rejection(
            item.name,
            f"stripe {1e3 * item.distance_m:.2f} mm off the plane of the other images, {item.size:.1f} times as far as "
            f"usual (leave-one-image-out)",
        )
        for item in out
    ]
    plane = fit_images(agreeing)
    names = {item.name for item in out}
    used = [view for view in views if view.name not in names]
    met = [stripe_points(camera, view.T_cam_board, view.stripe) for view in used if view.prior is None]
    return used, reasons, _rms(plane.distance(np.concatenate(met)))


def _view(scene: LaserScene, target: Target, correlation: float, arm: HandEye | None) -> LaserView | None:
    """Return what one image contributes; None where it has nothing to say."""
    points, pixels = corners(scene, target)
    empty = np.empty((0, 2))
    kept = scene.stripe.kept if scene.stripe else np.zeros(0, np.bool_)
    stripe, sigma = (scene.stripe.pixels[kept], scene.stripe.sigma_px[kept]) if scene.stripe else (empty, np.empty(0))
    if scene.board is not None:
        return LaserView(scene.name, points, pixels, stripe, sigma, correlation, scene.board.T_cam_board)
    if arm is None or scene.stripe is None or scene.image.T_base_tool is None:
        return None
    return LaserView(
        scene.name, points, pixels, stripe, sigma, correlation, arm.predicted_board(scene.image.T_base_tool), arm.sigmas
    )


def _image_points(
    scenes: Sequence[LaserScene], camera: CameraModel, along_columns: bool, correlation: float
) -> list[ImagePoints]:
    """Return where the stripe of each image meets its board; all points, for what is off its line speaks against an image too."""
    both = [(scene.name, scene.board, scene.stripe) for scene in scenes]
    met = [
        (name, stripe, np.broadcast_to(board.T_cam_board, (len(stripe), 4, 4)))
        for name, board, stripe in both
        if board is not None and stripe is not None
    ]
    points = [stripe_points(camera, poses, stripe.pixels) for _, stripe, poses in met]
    plane = fit_plane_robust(np.concatenate(points))
    return [
        ImagePoints(
            name, of_image, stripe_sigmas(camera, poses, of_image, stripe.sigma_px, plane, int(along_columns)), correlation,
            stripe.on_print,
        )
        for (name, stripe, poses), of_image in zip(met, points, strict=True)
    ]  # fmt: skip


def _check_spread(points: Sequence[ImagePoints]) -> None:
    depth = float(np.median(np.concatenate([item.points[:, 2] for item in points])))
    across = float(spread(points)[1])
    if across < _LEAST_SPREAD * depth:
        raise InputError(
            f"the stripes of all images lie on nearly one line (spread '{1e3 * across:.2f}' mm across it at {1e3 * depth:.0f} "
            "mm), which leaves the plane free to turn about it; take views at several distances, tilted both ways"
        )


def _camera_sigmas(camera: CameraModel, views: Sequence[LaserView], options: LaserOptions) -> FloatArray:
    """Return how freely each of the camera's parameters may move: zero for none."""
    count = len(camera_parameters(camera))
    boards = sum(len(view.points) > 0 for view in views)
    if not options.refine_camera or boards < LEAST_BOARDS_FOR_CAMERA:
        return np.zeros(count)
    return np.full(count, np.inf) if options.camera_sigmas is None else options.camera_sigmas


def _residuals(views: Sequence[LaserView], solution: JointSolution) -> list[StripeResidual]:
    bounds = np.cumsum([len(view.stripe) for view in views])[:-1]
    kept = np.split(solution.stripe_kept, bounds)
    total = np.sum([system.hessian for system in solution.systems], axis=0)
    residuals = []
    for index, (view, T) in enumerate(zip(views, solution.poses, strict=True)):
        if len(view.stripe):
            points = stripe_points(solution.camera, T, view.stripe)
            without = _without(solution, index, total)
            errors = _depth_errors(view, *without)
            distances = solution.plane.distance(points)
            residuals.append(StripeResidual(view.name, view.stripe, distances, points[:, 2], kept[index], errors))
    return residuals


def _without(solution: JointSolution, index: int, total: FloatArray) -> tuple[CameraModel, LaserPlane]:
    """Return camera and plane of all views but one: a linear re-solution of the reduced normal equations."""
    system = solution.systems[index]
    step = np.zeros(len(solution.free))
    step[solution.free] = solve_reduced(total - system.hessian, system.gradient)
    camera = with_parameters(solution.camera, camera_parameters(solution.camera) + step[:-3])
    return camera, solution.plane.moved(step[-3:])


def _depth_errors(view: LaserView, camera: CameraModel, plane: LaserPlane) -> FloatArray:
    """Return triangulated depth less that of the board (M,), metres; empty where no board shows."""
    board = board_pose(camera, view.points, view.pixels) if len(view.points) else None
    if board is None:
        return np.empty(0)
    difference = triangulated(camera, plane, view.stripe) - stripe_points(camera, board.T_cam_board, view.stripe)
    return difference[:, 2]


def _range(residuals: Sequence[StripeResidual]) -> tuple[float, float]:
    """Return the depths that the stripes cover, a fifth nearer and a quarter farther, in whole millimetres."""
    depths = np.concatenate([item.depths[item.kept] for item in residuals])
    near, far = _NEAR * float(depths.min()), _FAR * float(depths.max())
    return max(np.floor(1e3 * near), 1.0) / 1e3, np.ceil(1e3 * far) / 1e3


def _table(scenes: Sequence[LaserScene], solution: JointSolution, arm: HandEye | None) -> TableCheck | None:
    if arm is None:
        return None
    found = [
        (scene.name, scene.stripe.pixels[scene.stripe.kept], scene.image.T_base_tool @ arm.T_tool_cam)
        for scene in scenes
        if scene.stripe is not None and scene.image.T_base_tool is not None
    ]
    names, stripes, T_base_cam = zip(*found, strict=True)
    return check_table(solution.camera, solution.plane, names, stripes, np.stack(T_base_cam))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
