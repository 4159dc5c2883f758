"""What the stages hand to each other, on topics (see ``messages``) or, offline, as they are.

Time is ``int`` nanoseconds. ``T_a_b`` is a 4×4 matrix that maps points of frame b into frame a, ``p_a = T_a_b p_b``.
Metres, radians, seconds. Frames: ``map`` (gravity-aligned, z up), ``imu_link`` (body), ``camera_optical_frame``
(x right, y down, z forward). Every product carries the ``session`` it belongs to; a stage drops those of another session.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, IntFlag

import numpy as np

from vli_common.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray

NANOSECONDS = 1_000_000_000


class Exposure(Enum):
    """Which of the two interleaved exposures an image is."""

    LONG = "long"
    SHORT = "short"


class Mode(Enum):
    """Which sensors and constraints take part (command line ``--mode``)."""

    VLI_SLAM = "vli-slam"
    VLI_ODOM = "vli-odom"
    VI = "vi"
    VL = "vl"

    @property
    def uses_laser(self) -> bool:
        """True where the short frames are triangulated."""
        return self is not Mode.VI

    @property
    def uses_imu(self) -> bool:
        """True where the IMU takes part."""
        return self is not Mode.VL

    @property
    def uses_map(self) -> bool:
        """True where the window is aligned to the map, eq. (4)."""
        return self in (Mode.VLI_SLAM, Mode.VL)


class TrackingState(Enum):
    """State of the back end; a pose is published in TRACKING and DEGRADED only."""

    INITIALISING = "INITIALISING"
    TRACKING = "TRACKING"
    DEGRADED = "DEGRADED"
    LOST = "LOST"

    @property
    def has_pose(self) -> bool:
        """True where a pose is published."""
        return self in (TrackingState.TRACKING, TrackingState.DEGRADED)


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One instant of the IMU: angular rate (3,) rad/s and specific force (3,) m/s², in ``imu_link``."""

    stamp_ns: int
    gyro: FloatArray
    accel: FloatArray


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """An image as it came from the source, before decoding.

    Args:
        stamp_ns: mid-exposure.
        data: the bytes of the message.
        encoding: ``sensor_msgs`` encoding for a raw image (``bayer_rggb8``, ``rgb8``, ``mono16``, …); for a compressed one the
            ``format`` string (``jpeg``, ``bayer_rggb8; png compressed``).
        width, height, step: of a raw image; zeros for a compressed one.
        compressed: True for ``sensor_msgs/CompressedImage``.
        exposure_s, laser_on: what the exposure topic said of this stamp, or None.
    """

    stamp_ns: int
    data: bytes
    encoding: str
    width: int = 0
    height: int = 0
    step: int = 0
    compressed: bool = False
    exposure_s: float | None = None
    laser_on: bool | None = None


@dataclass(frozen=True, slots=True)
class Image:
    """A decoded image: pixels (H, W, 3) uint8 BGR or (H, W) uint8 grey; stamp is mid-exposure."""

    stamp_ns: int
    pixels: ByteArray
    session: int = 0
    exposure_s: float | None = None
    laser_on: bool | None = None

    @property
    def is_colour(self) -> bool:
        """True for a BGR image."""
        return self.pixels.ndim == 3


@dataclass(frozen=True, slots=True)
class LaserScan:
    """The triangulated stripe of one short frame; N is zero when nothing was seen.

    Args:
        stamp_ns: of the short frame.
        points: (N, 3) float64, camera frame, metres; ordered along the stripe.
        pixels: (N, 2) float64, raw (distorted) pixels u, v.
        intensity: (N,) float64, peak above the background, grey levels.
        sigma: (N,) float64, one standard deviation along the viewing ray, metres.
    """

    stamp_ns: int
    points: FloatArray
    pixels: FloatArray
    intensity: FloatArray
    sigma: FloatArray
    session: int = 0

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def empty(stamp_ns: int, session: int = 0) -> LaserScan:
        """Return a scan in which nothing was seen."""
        return LaserScan(stamp_ns, np.empty((0, 3)), np.empty((0, 2)), np.empty(0), np.empty(0), session)


class TrackFlag(IntFlag):
    """Flags of a row of :class:`Tracks`."""

    NONE = 0
    KEYFRAME = 1
    STATIONARY = 2
    NEW = 4
    """First observation of this id."""
    TEMPLATE = 8
    """A new patch was taken here: the position is not tied to the first observation any more, errors restart."""


@dataclass(frozen=True, slots=True)
class Tracks:
    """Features seen in one long frame.

    Args:
        stamp_ns: of the long frame.
        keyframe, stationary: of the frame as a whole.
        ids: (N,) int64, positive, never reused within a session.
        pixels: (N, 2) float64, raw (distorted) pixels.
        rays: (N, 2) float64, undistorted normalised x/z, y/z.
        velocity: (N, 2) float64, of ``rays``, 1/s.
        sigma_px: (N,) float64, per axis, grows with the track's age.
        stripe_px: (N,) float64, distance to the nearest stripe of an adjacent short frame, ``inf`` where none.
        flags: (N,) uint8, see :class:`TrackFlag`.
    """

    stamp_ns: int
    keyframe: bool
    stationary: bool
    ids: IntArray
    pixels: FloatArray
    rays: FloatArray
    velocity: FloatArray
    sigma_px: FloatArray
    stripe_px: FloatArray
    flags: ByteArray
    session: int = 0

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class Preintegration:
    """IMU preintegration from the last keyframe to one long frame.

    Args:
        stamp_ns: the frame it ends at (camera clock).
        from_ns: the keyframe it starts from (camera clock).
        measurements: a ``gtsam.PreintegratedCombinedMeasurements``.
        inflate: factor on the variances of the samples, already in ``measurements`` (> 1 where samples were interpolated).
    """

    stamp_ns: int
    from_ns: int
    measurements: object
    inflate: float = 1.0
    session: int = 0


@dataclass(frozen=True, slots=True)
class ImuBias:
    """Bias estimate at ``stamp_ns``: gyro (3,) rad/s, accel (3,) m/s²."""

    stamp_ns: int
    gyro: FloatArray
    accel: FloatArray
    session: int = 0


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """The live pose of one long frame, never changed afterwards.

    Args:
        stamp_ns: of the long frame.
        T_map_imu: (4, 4).
        T_map_odom: (4, 4), steps with map constraints; ``odom`` → ``imu_link`` is continuous.
        velocity: (3,) of imu_link in map, m/s.
        angular_velocity: (3,) of imu_link in imu_link, rad/s.
        covariance: (6, 6) of the pose, order x y z rotation-x y z as in ROS (position in map, rotation about the axes of map).
    """

    stamp_ns: int
    T_map_imu: FloatArray
    T_map_odom: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    covariance: FloatArray
    session: int = 0


class FrameKind(Enum):
    """Kind of a frame in the window; the value is its code on the topic."""

    KEYFRAME = 0
    LONG = 1
    SHORT = 2


@dataclass(frozen=True, slots=True)
class WindowPoses:
    """Poses of all frames that the window holds, once a keyframe.

    Args:
        stamp_ns: newest keyframe.
        stamps: (N,) int64, ascending.
        kinds: (N,) uint8, :class:`FrameKind` codes.
        final: (N,) bool, True for a frame that has left the window: its pose will not change again, it is sent for the last time.
        redundant: (N,) bool, True for a scan taken at rest that adds nothing to the map.
        T_map_camera: (N, 4, 4).
        located: False where ``map`` is a guess, from a loss to a relocalisation.
        placement: counts the losses and relocalisations of the session; poses of two placements differ by an unknown motion.
    """

    stamp_ns: int
    stamps: IntArray
    kinds: ByteArray
    final: BoolArray
    redundant: BoolArray
    T_map_camera: FloatArray
    session: int = 0
    located: bool = True
    placement: int = 0

    def __len__(self) -> int:
        return len(self.stamps)


@dataclass(frozen=True, slots=True)
class Relocalisation:
    """Where a session is in the map.

    Args:
        stamp_ns: newest keyframe of the window that was found.
        T_map_session: (4, 4) from what was published as ``map`` with that window to the map.
        sigma_m: one standard deviation of the position, metres.
    """

    stamp_ns: int
    T_map_session: FloatArray
    sigma_m: float
    session: int = 0


@dataclass(frozen=True, slots=True)
class MapConstraints:
    """Window-to-map correspondences, eq. (4): stripe points, their map points and normals.

    Args:
        stamp_ns: newest keyframe of the window that was associated.
        scan_stamps: (N,) int64, the short frame of each point.
        points_camera: (N, 3), v_i in the camera frame of that short frame.
        points_map: (N, 3), v_i^g.
        normals_map: (N, 3), unit n_i^g.
        sigma: (N,) metres, of the point-to-plane distance.
        weight: (N,), w_i in [0, 1].
    """

    stamp_ns: int
    scan_stamps: IntArray
    points_camera: FloatArray
    points_map: FloatArray
    normals_map: FloatArray
    sigma: FloatArray
    weight: FloatArray
    session: int = 0

    def __len__(self) -> int:
        return len(self.points_map)


@dataclass(frozen=True, slots=True)
class PointCloud:
    """Coloured points in ``map``: points (N, 3), colours (N, 3) uint8 RGB, normals (N, 3) (0 = none), weights (N,) merges."""

    stamp_ns: int
    points: Float32Array
    colours: ByteArray
    normals: Float32Array | None = None
    weights: Float32Array | None = None
    session: int = 0

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True)
class FrontEndOutput:
    """What the front end says of one long frame."""

    tracks: Tracks
    preintegration: Preintegration | None


@dataclass(frozen=True, slots=True)
class BackEndOutput:
    """What the back end says of one long frame; ``pose`` is None in INITIALISING and LOST."""

    stamp_ns: int
    state: TrackingState
    reason: str
    pose: PoseEstimate | None = None
    window: WindowPoses | None = None
    bias: ImuBias | None = None


@dataclass(frozen=True, slots=True)
class MappingOutput:
    """What one window update changed in the map."""

    constraints: MapConstraints | None = None
    cloud: PointCloud | None = None
    """The newest coloured stripes, live."""
    update: PointCloud | None = None
    """Points that entered the map, final."""
    relocalisation: Relocalisation | None = None
    """Where the session is in the map, once it has been found again."""


@dataclass(slots=True)
class Counters:
    """Named counters of a stage; every drop has one."""

    values: dict[str, int] = field(default_factory=dict)

    def add(self, name: str, count: int = 1) -> None:
        """Add ``count`` to counter ``name``."""
        if count:
            self.values[name] = self.values.get(name, 0) + count

    def __getitem__(self, name: str) -> int:
        """Return a count, 0 for what never occurred."""
        return self.values.get(name, 0)
