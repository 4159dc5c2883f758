"""Parameters of the back end."""

from __future__ import annotations

from dataclasses import dataclass

from vli_common.config import parameter, section


@dataclass(frozen=True)
class SceneConfig:
    """Distances of the scene, from which every default that is a depth follows."""

    near_m: float = parameter(
        0.0, unit="m", minimum=0.0, maximum=1000.0, doc="nearest surface; 0: that of laser0.range_m, else 0.02"
    )
    far_m: float = parameter(
        0.0, unit="m", minimum=0.0, maximum=1000.0, doc="farthest surface; 0: that of laser0.range_m, else 0.15"
    )


@dataclass(frozen=True)
class BackEndConfig:
    """Window, residual sigmas and state machine. Every residual is in units of its measured sigma."""

    window_keyframes: int = parameter(
        10, unit="keyframes", minimum=4, maximum=20, doc="keyframes in the window (the paper has 8); more: steadier, slower"
    )
    pixel_sigma: float = parameter(
        0.3,
        unit="px",
        minimum=0.05,
        maximum=5.0,
        doc="floor of the track sigma, covers what frames share (0.2 to 0.5 measure alike)",
    )
    depth_sigma: float = parameter(
        1.0e-4,
        unit="m",
        minimum=1.0e-5,
        maximum=1.0e-2,
        doc="floor of the laser depth of a feature, eq. (2), at 30 mm; grows with z²",
    )
    cauchy: float = parameter(0.5, unit="sigma", minimum=0.1, maximum=100.0, doc="where the robust loss starts to turn over")
    iterations: int = parameter(
        4, minimum=1, maximum=50, doc="re-linearisations a keyframe; more: slower, needed only after a start"
    )
    start_iterations: int = parameter(
        15, minimum=1, maximum=100, doc="the same for the first keyframes in motion, whose depths are guesses"
    )
    start_keyframes: int = parameter(
        8, unit="keyframes", minimum=1, maximum=50, doc="how many keyframes in motion count as first ones"
    )
    depth_window_s: float = parameter(
        0.11, unit="s", minimum=0.01, maximum=1.0, doc="scans this near to a keyframe give its features depth"
    )
    depth_radius_px: float = parameter(
        12.0, unit="px", minimum=1.0, maximum=100.0, doc="stripe points this near to a feature give it depth"
    )
    depth_min_points: int = parameter(8, unit="points", minimum=4, maximum=1000, doc="fewest stripe points in a depth plane")
    depth_max_rms: float = parameter(
        1.2e-4,
        unit="m",
        minimum=1.0e-5,
        maximum=1.0e-2,
        doc="roughest depth plane; more lets edges in, less drops rough surfaces",
    )
    primary_only: bool = parameter(
        True, doc="one laser depth a feature, from the frame nearest to the stripe (the paper); false: all frames"
    )
    map_sigma_scale: float = parameter(
        5.8,
        minimum=0.1,
        maximum=100.0,
        doc="factor on the sigma of eq. (4): its points are correlated (1/5.8² = 0.03 of their information)",
    )
    map_cauchy: float = parameter(2.0, unit="sigma", minimum=0.1, maximum=100.0, doc="robust loss of eq. (4)")
    covariance_scale: float = parameter(
        0.4,
        minimum=0.01,
        maximum=100.0,
        doc="factor on the published variances; the residuals' sigmas are wide on purpose: a third of the NEES measured with 1",
    )
    tilt_sigma: float = parameter(
        1.0e-4,
        unit="rad",
        minimum=1.0e-6,
        maximum=1.0,
        doc="of the start attitude; tilt is gauge, the accelerometer bias absorbs it",
    )
    gyro_bias_sigma: float = parameter(0.02, unit="rad/s", minimum=1.0e-5, maximum=1.0, doc="first guess of the gyro bias")
    accel_bias_sigma: float = parameter(
        0.2, unit="m/s²", minimum=1.0e-4, maximum=5.0, doc="first guess of the accelerometer bias"
    )
    start_rest_s: float = parameter(0.4, unit="s", minimum=0.05, maximum=10.0, doc="rest needed for a start at rest")
    start_parallax_px: float = parameter(20.0, unit="px", minimum=1.0, maximum=500.0, doc="parallax needed for a start in motion")
    start_min_keyframes: int = parameter(4, unit="keyframes", minimum=3, maximum=8, doc="keyframes needed for a start in motion")
    start_scale_sigma: float = parameter(
        0.03,
        minimum=0.001,
        maximum=1.0,
        doc="a start without laser waits until the IMU knows the scale this well, relative; lower: starts later, truer",
    )
    start_patience_s: float = parameter(
        5.0,
        unit="s",
        minimum=0.1,
        maximum=1000.0,
        doc="in motion for longer without a start, that sigma grows in proportion, up to 0.15; the scale is sharpened later",
    )
    min_landmarks: int = parameter(
        12, unit="features", minimum=5, maximum=200, doc="fewer in a frame: DEGRADED, the IMU carries it"
    )
    lost_after_s: float = parameter(
        1.0, unit="s", minimum=0.05, maximum=10.0, doc="without enough landmarks for longer: LOST; longer: the IMU drifts further"
    )
    laser_check: bool = parameter(
        True, doc="warn where laser depths contradict what vision and IMU see: the laser plane may have moved"
    )
    scene: SceneConfig = section(SceneConfig)
