"""Parameters of the front end."""

from __future__ import annotations

from dataclasses import dataclass

from vli_common.config import parameter, section


@dataclass(frozen=True)
class KltConfig:
    """Tracking of points from one long frame to the next, and to the patch seen at birth."""

    normalisation_px: int = parameter(
        21,
        unit="px",
        minimum=1,
        maximum=63,
        doc="width of the local mean and standard deviation, 1: none; wider: more texture, less immune to the on-board light",
    )
    window_px: int = parameter(
        21,
        unit="px",
        minimum=7,
        maximum=41,
        doc="window of Lucas–Kanade; wider: steadier on weak texture, slower, blurs depth edges",
    )
    pyramid_levels: int = parameter(4, minimum=0, maximum=6, doc="halvings of the image; more: faster motion can be followed")
    forward_backward_px: float = parameter(
        0.5,
        unit="px",
        minimum=0.1,
        maximum=5.0,
        doc="a track that does not come back this close is lost; below 0.25 good points on weak texture are lost",
    )
    alignment: bool = parameter(True, doc="align to the patch seen at birth, with a model of the light: less drift, 1 ms a frame")
    min_correlation: float = parameter(
        0.8, minimum=0.0, maximum=1.0, doc="of the aligned patch with the one seen at birth; higher: more new patches"
    )
    max_correction_px: float = parameter(
        2.0, unit="px", minimum=0.1, maximum=10.0, doc="an alignment farther than this from Lucas–Kanade is not believed"
    )
    outlier_px: float = parameter(
        1.0, unit="px", minimum=0.1, maximum=10.0, doc="distance from the epipolar line beyond which a track is dropped"
    )


@dataclass(frozen=True)
class DetectionConfig:
    """Choice of new points."""

    quality: float = parameter(
        0.01,
        minimum=1e-4,
        maximum=0.5,
        doc="least corner response, as a share of the strongest; lower: more points on weak texture",
    )
    distance_px: float = parameter(20.0, unit="px", minimum=3.0, maximum=200.0, doc="between points; larger: fewer, more even")
    cells: int = parameter(8, minimum=1, maximum=32, doc="columns of the grid that spreads the points over the image")


@dataclass(frozen=True)
class KeyframeConfig:
    """When a long frame becomes a keyframe."""

    parallax_px: float = parameter(
        38.0,
        unit="px at f = 460 px",
        minimum=1.0,
        maximum=500.0,
        doc="mean motion since the last keyframe, rotation taken out; larger: fewer keyframes",
    )
    parallax_vi_px: float = parameter(
        20.0,
        unit="px at f = 460 px",
        minimum=1.0,
        maximum=500.0,
        doc="the same without the laser: the scale is the IMU's, which knows the tremor of a hand from near keyframes only",
    )
    min_tracks: int = parameter(
        40, unit="tracks", minimum=5, maximum=1000, doc="fewer in common with the last keyframe make a new one"
    )
    motion_s: float = parameter(
        0.33,
        unit="s",
        minimum=0.05,
        maximum=10.0,
        doc="longest interval in motion; longer: the IMU drifts more between keyframes",
    )
    rest_s: float = parameter(2.0, unit="s", minimum=0.05, maximum=60.0, doc="longest interval at rest")
    rest_flow_px: float = parameter(
        0.7,
        unit="px",
        minimum=0.01,
        maximum=20.0,
        doc="median motion since the last keyframe below which the scanner may be at rest",
    )
    rest_gyro: float = parameter(
        0.05, unit="rad/s", minimum=1e-3, maximum=1.0, doc="mean angular rate below which the scanner may be at rest"
    )


@dataclass(frozen=True)
class ImuConfig:
    """Use of the IMU between frames; noise is that of the calibration times a factor."""

    gyroscope_factor: float = parameter(
        2.0, minimum=0.1, maximum=100.0, doc="on the gyroscope's noise density; higher: trusts the images more"
    )
    accelerometer_noise: float = parameter(
        0.02,
        unit="m/s²/√Hz",
        minimum=0.0,
        maximum=10.0,
        doc="least accelerometer noise density; 5–25 times the data sheet: errors of the start attitude do not bend the path",
    )
    walk_factor: float = parameter(2.0, minimum=0.1, maximum=100.0, doc="on both random walks; higher: biases may change faster")
    interpolated_gap_s: float = parameter(
        0.05, unit="s", minimum=0.0, maximum=1.0, doc="across gaps up to this the gyroscope still predicts where features go"
    )
    longest_gap_s: float = parameter(
        0.5, unit="s", minimum=0.0, maximum=5.0, doc="an interval with a longer gap has no IMU factor"
    )
    max_wait_s: float = parameter(
        0.05, unit="s", minimum=0.005, maximum=0.5, doc="a frame that the IMU does not cover by then goes on without it"
    )


@dataclass(frozen=True)
class TimeShiftConfig:
    """Online check of the camera–IMU time shift."""

    online: bool = parameter(True, doc="correct a time shift that is certainly wrong; false: that of the calibration stays")
    memory_s: float = parameter(
        10.0, unit="s", minimum=4.0, maximum=600.0, doc="how long a pair of frames counts; longer: surer, corrects later"
    )
    least_s: float = parameter(
        4.0e-4,
        unit="s",
        minimum=1.0e-5,
        maximum=0.1,
        doc="smaller errors are left alone; lower: also corrects what hardly matters",
    )
    largest_s: float = parameter(
        0.04, unit="s", minimum=0.0, maximum=1.0, doc="farthest from the calibration that a correction may lead"
    )


@dataclass(frozen=True)
class FrontEndConfig:
    """Features, keyframes and preintegration."""

    max_features: int = parameter(
        100, unit="points", minimum=20, maximum=1000, doc="points tracked; more: steadier, slower (front and back end)"
    )
    sigma_px: float = parameter(
        0.04,
        unit="px",
        minimum=0.01,
        maximum=5.0,
        doc="least error of a track per axis; what its own alignment says comes on top",
    )
    sigma_growth_px: float = parameter(
        0.002, unit="px a frame", minimum=0.0, maximum=1.0, doc="growth of a track's error with its age; 0.008 without alignment"
    )
    klt: KltConfig = section(KltConfig)
    detection: DetectionConfig = section(DetectionConfig)
    keyframe: KeyframeConfig = section(KeyframeConfig)
    imu: ImuConfig = section(ImuConfig)
    time_shift: TimeShiftConfig = section(TimeShiftConfig)
