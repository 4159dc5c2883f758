"""Parameters of source, demultiplexer and stripe detector."""

from __future__ import annotations

from dataclasses import dataclass

from vli_common.config import parameter


@dataclass(frozen=True)
class DriverConfig:
    """Where the data come from."""

    image_topic: str = parameter("/camera/image_raw", doc="Image or CompressedImage; NAME also finds NAME/compressed")
    imu_topic: str = parameter("/imu", doc="sensor_msgs/Imu")
    camera_info_topic: str = parameter("/camera/camera_info", doc="optional, checked against the calibration")
    exposure_topic: str = parameter(
        "/camera/exposure", doc="optional, DiagnosticArray with exposure_s and laser; makes the demultiplexer exact"
    )
    exposure_long_s: float = parameter(
        5e-3, unit="s", minimum=1e-5, maximum=0.1, doc="long exposure, laser off; longer: brighter images, more motion blur"
    )
    exposure_short_s: float = parameter(
        3e-4, unit="s", minimum=1e-5, maximum=0.1, doc="short exposure, laser on; shorter: less ambient light, dimmer stripe"
    )


@dataclass(frozen=True)
class DemuxConfig:
    """How long and short exposures are told apart where no exposure topic says it."""

    min_ratio: float = parameter(
        1.5,
        minimum=1.1,
        maximum=20.0,
        doc="brightness of long over short frames that counts as alternating; lower: locks on weaker contrast",
    )
    start_s: float = parameter(
        2.0, unit="s", minimum=0.1, maximum=60.0, doc="a stream that has not alternated for this long is taken as all long"
    )
    max_gap_s: float = parameter(
        0.5, unit="s", minimum=0.05, maximum=10.0, doc="after a longer gap the rhythm is not trusted, brightness alone decides"
    )
    adaptation: float = parameter(
        0.1,
        minimum=0.01,
        maximum=1.0,
        doc="how fast the two brightness levels follow, per frame; faster: survives steps, slower: survives flashes",
    )


@dataclass(frozen=True)
class StripeConfig:
    """Detection of the laser stripe in the short frames."""

    channel: str = parameter(
        "auto",
        choices=("auto", "red", "green", "blue", "grey"),
        doc="where the laser is seen; auto: the channel with the strongest stripe",
    )
    orientation: str = parameter(
        "auto",
        choices=("auto", "columns", "rows"),
        doc="columns: one point per image column (stripe roughly horizontal), rows: one per row; auto: from the laser plane",
    )
    smoothing_px: float = parameter(
        1.0, unit="px", minimum=0.3, maximum=5.0, doc="sigma of the Gaussian across the stripe before the peak is sought"
    )
    window_sigmas: float = parameter(
        3.5,
        minimum=2.0,
        maximum=6.0,
        doc="half the widest window of the centre of mass, in sigmas of the line; wider: noisier, narrower: biased",
    )
    min_snr: float = parameter(
        6.0,
        minimum=3.0,
        maximum=50.0,
        doc="smoothed peak above the background in sigmas of its noise; lower: finds dimmer stripes and false ones",
    )
    min_peak: float = parameter(10.0, unit="grey levels", minimum=1.0, maximum=200.0, doc="smoothed peak above the background")
    max_width_px: float = parameter(
        12.0, unit="px", minimum=2.0, maximum=100.0, doc="width at half height beyond which a peak is no laser line"
    )
    min_colour_ratio: float = parameter(
        1.3,
        minimum=0.0,
        maximum=10.0,
        doc="light in the laser's channel over that in the others, in colour images; 0 for a white line",
    )
    max_lean: float = parameter(
        0.03,
        minimum=0.005,
        maximum=1.0,
        doc="asymmetry, share of the width, beyond which an edge cuts the line; lower: fewer wrong points at edges",
    )
    ambiguity: float = parameter(
        0.6,
        minimum=0.1,
        maximum=1.0,
        doc="a second peak of this share of the first makes a column ambiguous unless its neighbours decide",
    )
    max_jump_px: float = parameter(
        3.0, unit="px", minimum=0.5, maximum=50.0, doc="neighbouring columns that jump further belong to different segments"
    )
    min_segment_points: int = parameter(
        15, unit="points", minimum=1, maximum=1000, doc="shorter segments are dropped: fewer false points"
    )
    trim_points: int = parameter(
        2,
        unit="points",
        minimum=0,
        maximum=20,
        doc="dropped at either end of a segment, where an edge cuts the line; more: fewer wrong points",
    )
    min_points: int = parameter(
        20, unit="points", minimum=1, maximum=1000, doc="a frame with fewer points counts as having no stripe"
    )
    range_margin: float = parameter(
        0.1, minimum=0.0, maximum=1.0, doc="share by which the searched band exceeds laser0.range_m on either side"
    )
    sigma_floor_px: float = parameter(
        0.02,
        unit="px",
        minimum=0.0,
        maximum=1.0,
        doc="least error of a point, whatever its noise says: what the lens model leaves",
    )
