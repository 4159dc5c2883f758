"""Stages that know the truth: each is a stage of the product whose input, or output, is replaced by what a perfect one would say.

What is left of the error then comes from the other stages. Weights stay those of the measured quantities, so that nothing
but the error itself changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Flag, auto
from functools import partial

import numpy as np
from ground_truth import TrueMotion, Truth
from scipy.ndimage import uniform_filter1d

from vli_backend.backend import BackEnd
from vli_backend.config import BackEndConfig
from vli_backend.dead_reckoning import DeadReckoning
from vli_backend.depth_prior import DepthPrior
from vli_backend.estimator import WindowEstimator
from vli_backend.smoother import KeyframeState, StatePrior
from vli_backend.starter import Starter
from vli_bringup.pipeline import Stages
from vli_bringup.settings import Settings
from vli_common.arrays import FloatArray
from vli_common.calibration import Calibration
from vli_common.geometry import inverse
from vli_common.types import (
    EncodedImage,
    FrontEndOutput,
    Image,
    ImuSample,
    LaserScan,
    MappingOutput,
    Mode,
    TrackFlag,
    Tracks,
    WindowPoses,
)
from vli_driver.scanner import StripeScanner
from vli_driver.triangulation import stripe_runs_across_columns
from vli_frontend.frontend import FrontEnd
from vli_mapping.mapper import Mapper

_SEARCH_PX = np.linspace(-3.0, 3.0, 13)
"""The true stripe is looked for this near to the detected one."""
_STEP_SHARE = 0.05
"""Between two search positions the surface is no edge while depth changes by less than this share."""
_BIAS_WINDOW_S = 2.0
"""Measured minus ideal, averaged over this long, is the bias: its noise is a hundredth of what matters."""
KNOWN_START = ("backend.gyro_bias_sigma=1e-4", "backend.accel_bias_sigma=2e-3")
"""Settings that say so where the state at the start is true."""


class Injection(Flag):
    """What is replaced by the truth."""

    NOTHING = 0
    STRIPE = auto()
    TRACKS = auto()
    BIAS = auto()
    IMU = auto()
    START = auto()
    MAPPING_POSES = auto()


def true_stripe(truth: Truth, scan: LaserScan) -> LaserScan:
    """Return the scan where it truly was: on the surface and in the laser plane; what is on no surface is left out."""
    calibration = truth.calibration
    if calibration.laser is None or not len(scan):
        return scan
    across = np.array([0.0, 1.0] if stripe_runs_across_columns(calibration.laser) else [1.0, 0.0])
    tried = scan.pixels[:, None] + _SEARCH_PX[:, None] * across
    rays = calibration.camera.unproject(tried.reshape(-1, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = -calibration.laser.d / (rays @ calibration.laser.normal[:2] + calibration.laser.normal[2])
    surface = truth.depth(scan.stamp_ns, rays)
    found = stripe_offsets(surface.reshape(len(scan), -1), plane.reshape(len(scan), -1), _SEARCH_PX)
    seen = np.isfinite(found)
    pixels = scan.pixels[seen] + found[seen, None] * across
    homogeneous = np.column_stack([calibration.camera.unproject(pixels), np.ones(len(pixels))])
    depth = -calibration.laser.d / (homogeneous @ calibration.laser.normal)
    return replace(
        scan,
        points=depth[:, None] * homogeneous,
        pixels=pixels,
        intensity=scan.intensity[seen],
        sigma=scan.sigma[seen],
    )


def stripe_offsets(surface: FloatArray, plane: FloatArray, offsets: FloatArray) -> FloatArray:
    """Return (N,) the offset nearest to zero at which a surface crosses the laser plane; NaN where none does.

    Args:
        surface, plane: (N, M) depths at M offsets across the stripe.
        offsets: (M,) ascending.
    """
    gap = surface - plane
    with np.errstate(invalid="ignore", divide="ignore"):
        crosses = gap[:, :-1] * gap[:, 1:] <= 0
        crosses &= np.abs(np.diff(surface, axis=1)) < _STEP_SHARE * surface[:, :-1]
        share = gap[:, :-1] / (gap[:, :-1] - gap[:, 1:])
        roots = np.where(crosses, offsets[:-1] + share * np.diff(offsets), np.nan)
    nearest = np.abs(np.where(np.isfinite(roots), roots, np.inf)).argmin(axis=1)
    result: FloatArray = roots[np.arange(len(roots)), nearest]
    return result


class TrueStripeScanner(StripeScanner):
    """Finds the stripe as ever, then reports it without an error."""

    def __init__(self, calibration: Calibration, settings: Settings, truth: Truth) -> None:
        super().__init__(calibration, settings.stripe)
        self._truth = truth

    def scan(self, short: Image) -> LaserScan:
        """See :meth:`StripeScanner.scan`."""
        return true_stripe(self._truth, super().scan(short))


class TrueTracks:
    """Replaces the positions of tracks by those of the surface point that their first observation saw.

    Args:
        truth: of the recording.
    """

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self._points: dict[int, FloatArray] = {}

    def __call__(self, tracks: Tracks) -> Tracks:
        """Return the tracks without an error; those that begin beside the surface are left out."""
        self._meet(tracks)
        points = np.array([self._points[key] for key in tracks.ids.tolist()]).reshape(-1, 3)
        kept = np.isfinite(points).all(axis=1)
        rays = self._truth.rays(tracks.stamp_ns, points[kept])
        pixels = self._truth.calibration.camera.project(np.column_stack([rays, np.ones(len(rays))]))
        columns = {name: getattr(tracks, name)[kept] for name in ("ids", "velocity", "sigma_px", "stripe_px")}
        # A new patch begins where the old one ended: to a track without drift nothing has happened.
        flags = tracks.flags[kept] & ~np.uint8(TrackFlag.TEMPLATE)
        return replace(tracks, rays=rays, pixels=pixels, flags=flags, **columns)

    def _meet(self, tracks: Tracks) -> None:
        """Find the surface points of new tracks."""
        fresh = np.array([key not in self._points for key in tracks.ids.tolist()], np.bool_)
        if fresh.any():
            points = self._truth.points(tracks.stamp_ns, tracks.rays[fresh])
            self._points.update(zip(tracks.ids[fresh].tolist(), points, strict=True))


class TrueTracksFrontEnd(FrontEnd):
    """Tracks as ever, so that births, losses and keyframes are those of the images; reports the tracks without an error."""

    def __init__(self, calibration: Calibration, settings: Settings, mode: Mode, truth: Truth) -> None:
        super().__init__(calibration, settings.frontend, mode)
        self._true_tracks = TrueTracks(truth)

    def add_imu(self, sample: ImuSample) -> list[FrontEndOutput]:
        """See :meth:`FrontEnd.add_imu`."""
        return self._corrected(super().add_imu(sample))

    def add_image(self, image: Image) -> list[FrontEndOutput]:
        """See :meth:`FrontEnd.add_image`."""
        return self._corrected(super().add_image(image))

    def _corrected(self, frames: list[FrontEndOutput]) -> list[FrontEndOutput]:
        return [replace(frame, tracks=self._true_tracks(frame.tracks)) for frame in frames]


class TruePosesMapper(Mapper):
    """Maps with the true poses, in the frame that the first of them gives."""

    def __init__(self, calibration: Calibration, settings: Settings, mode: Mode, truth: Truth) -> None:
        super().__init__(calibration, settings.mapping, mode)
        self._truth = truth
        self._T_map_world: FloatArray | None = None

    def add_window(self, window: WindowPoses) -> MappingOutput:
        """See :meth:`Mapper.add_window`."""
        true_poses = self._truth.poses(window.stamps)
        if self._T_map_world is None:
            self._T_map_world = window.T_map_camera[0] @ inverse(true_poses[0])
        return super().add_window(replace(window, T_map_camera=self._T_map_world @ true_poses))


class TrueStarter(Starter):
    """Starts at the first keyframe after a stripe, at rest or in motion, with the true state; ``map`` is the world.

    Args:
        calibration, config, mode: see :class:`Starter`.
        imu: true motion and biases.
    """

    def __init__(self, calibration: Calibration, config: BackEndConfig, mode: Mode, imu: ImuTruth) -> None:
        super().__init__(calibration, config, mode)
        self._truth = imu
        self._stripes: list[LaserScan] = []
        self._start = (calibration, config)

    def add_scan(self, scan: LaserScan) -> None:
        """See :meth:`Starter.add_scan`."""
        self._stripes = [*self._stripes[-4:], scan]

    def add_frame(self, frame: FrontEndOutput, place: DeadReckoning) -> WindowEstimator | None:
        """See :meth:`Starter.add_frame`."""
        tracks = frame.tracks
        if not tracks.keyframe or not self._stripes:
            self.reason = "waiting for a stripe and a keyframe"
            return None
        calibration, config = self._start
        prior = StatePrior(np.full(3, config.tilt_sigma), 1e-6, 1e-3, config.gyro_bias_sigma, config.accel_bias_sigma)
        depths = DepthPrior.of_scene(calibration, config)
        self.reason = "started with the truth"
        return WindowEstimator(calibration, config, tracks, self._truth.state(tracks.stamp_ns), prior, self._stripes, depths)


@dataclass(frozen=True)
class ImuTruth:
    """What the IMU should have measured, and what it did.

    Args:
        motion: of the IMU.
        samples: as recorded.
        ideal: (N, 6) rate and specific force without an error.
        bias: (N, 6) slow part of the recorded errors.
        left: (N, 6) what is left of ``bias`` in the samples that are played.
    """

    motion: TrueMotion
    samples: list[ImuSample]
    ideal: FloatArray
    bias: FloatArray
    left: FloatArray

    @staticmethod
    def of(samples: list[ImuSample], motion: TrueMotion, what: Injection) -> ImuTruth:
        """Compare the samples with the true motion."""
        stamps = np.array([sample.stamp_ns for sample in samples])
        ideal = motion.imu(stamps)
        measured = np.array([np.concatenate([sample.gyro, sample.accel]) for sample in samples])
        bias = bias_of(measured - ideal, float(np.median(np.diff(stamps))) * 1e-9)
        left = np.zeros_like(bias) if what & (Injection.BIAS | Injection.IMU) else bias
        return ImuTruth(motion, samples, ideal, bias, left)

    def played(self, what: Injection) -> list[ImuSample]:
        """Return the samples as recorded, without bias, or as an ideal IMU measures them."""
        if Injection.IMU in what:
            return [replace(s, gyro=row[:3], accel=row[3:]) for s, row in zip(self.samples, self.ideal, strict=True)]
        if Injection.BIAS in what:
            return [replace(s, gyro=s.gyro - b[:3], accel=s.accel - b[3:]) for s, b in zip(self.samples, self.bias, strict=True)]
        return self.samples

    def state(self, camera_ns: int) -> KeyframeState:
        """Return the true state at a stamp of the camera."""
        imu_ns = np.array([camera_ns + self.motion.timeshift_ns])
        stamps = np.array([sample.stamp_ns for sample in self.samples])
        bias = self.left[min(int(np.searchsorted(stamps, imu_ns[0])), len(stamps) - 1)]
        kinematics = self.motion.state(imu_ns)
        return KeyframeState(kinematics.T_world_imu[0], kinematics.velocity[0], bias[:3], bias[3:])


def bias_of(errors: FloatArray, period_s: float) -> FloatArray:
    """Return the slow part (N, 6) of an IMU's errors (N, 6)."""
    result: FloatArray = uniform_filter1d(errors, max(1, round(_BIAS_WINDOW_S / period_s)), axis=0, mode="reflect")
    return result


@dataclass(frozen=True)
class Experiment:
    """A pipeline's stages, some of which know the truth, and what to push through them."""

    stages: Stages
    items: list[EncodedImage | ImuSample]


def experiment(
    items: list[EncodedImage | ImuSample], truth: Truth, settings: Settings, mode: Mode, what: Injection
) -> Experiment:
    """Return fresh stages and the items for them, with the truth where it is asked for.

    Args:
        items: of a bag, in their order.
        truth: of the recording.
        settings: of the stages.
        mode: which sensors take part.
        what: is true.
    """
    calibration = truth.calibration
    stages = Stages.create(calibration, settings, mode)
    if Injection.STRIPE in what and mode.uses_laser:
        stages.scanner = TrueStripeScanner(calibration, settings, truth)
    if Injection.TRACKS in what:
        stages.front_end = TrueTracksFrontEnd(calibration, settings, mode, truth)
    if Injection.MAPPING_POSES in what:
        stages.mapper = TruePosesMapper(calibration, settings, mode, truth)
    if what & (Injection.BIAS | Injection.IMU | Injection.START):
        imu = ImuTruth.of([item for item in items if isinstance(item, ImuSample)], TrueMotion(truth), what)
        if Injection.START in what:
            stages.back_end = BackEnd(calibration, settings.backend, mode, partial(TrueStarter, imu=imu))
        played = iter(imu.played(what))
        items = [next(played) if isinstance(item, ImuSample) else item for item in items]
    return Experiment(stages, items)
