"""Parameters of the mapping stage."""

from __future__ import annotations

from dataclasses import dataclass

from vli_common.config import parameter, section

COMPENSATED, AS_SEEN = "compensated", "lit"
"""Values of ``colour``."""


@dataclass(frozen=True)
class MapConfig:
    """What one point of the map is, and what may merge with it."""

    merge_radius: float = parameter(
        1.5e-4,
        unit="m",
        minimum=1.0e-5,
        maximum=1.0e-2,
        doc="nearer points become one; larger: fewer points, less noise, less detail",
    )
    merge_angle_deg: float = parameter(
        45.0, unit="deg", minimum=5.0, maximum=90.0, doc="normals farther apart do not merge; larger: rounds edges off"
    )
    merge_colour: float = parameter(
        60.0,
        unit="grey levels",
        minimum=1.0,
        maximum=255.0,
        doc="colours farther apart, in any channel, do not merge; larger: blurs print",
    )
    max_weight: float = parameter(
        20.0,
        unit="points",
        minimum=1.0,
        maximum=1.0e6,
        doc="cap on the points merged, lest old ones drown the rest; larger: slower to follow",
    )
    normal_radius: float = parameter(
        8.0e-4,
        unit="m",
        minimum=1.0e-4,
        maximum=1.0e-2,
        doc="neighbours that give a normal; larger: less noise, rounds edges off",
    )
    fill_radius: float = parameter(
        4.0e-4,
        unit="m",
        minimum=0.0,
        maximum=1.0e-2,
        doc="doubtful points stay only where no solid one is this near; larger: fewer outliers, gaps",
    )
    ray_radius: float = parameter(
        2.0e-4,
        unit="m",
        minimum=0.0,
        maximum=1.0e-3,
        doc="a view that passes a point this near speaks against it; larger: fewer ghosts, thinner edges; 0: off",
    )
    ray_margin: float = parameter(
        5.0e-4,
        unit="m",
        minimum=1.0e-5,
        maximum=1.0e-2,
        doc="unless the point is this near in range to what is seen; smaller: fewer flying points, less surface",
    )
    hiding_weight: float = parameter(
        3.0,
        unit="points",
        minimum=0.0,
        maximum=1.0e6,
        doc="weight of the map in the way of a view from which on its end is doubted; smaller: fewer ghosts below",
    )
    piece_share: float = parameter(
        0.02,
        minimum=1.0e-3,
        maximum=1.0,
        doc="share of a piece of stripe that views contradict from which on the rest leaves too; smaller: fewer ghosts; 1: off",
    )
    min_planarity: float = parameter(
        0.75, minimum=0.0, maximum=1.0, doc="flatness below which a point has no normal rather than a wrong one"
    )


@dataclass(frozen=True)
class EntryConfig:
    """Which stripe points are solid; the others are doubtful, see ``map.fill_radius``."""

    edge_jump: float = parameter(
        5.0e-4, unit="m", minimum=5.0e-5, maximum=1.0e-2, doc="step between neighbours of a stripe that is an occlusion edge"
    )
    edge_trim: int = parameter(
        1, unit="points", minimum=0, maximum=20, doc="points doubted on either side of such a step: half a spot each, they fly"
    )
    min_segment: int = parameter(
        5,
        unit="points",
        minimum=1,
        maximum=1000,
        doc="shorter pieces between two steps are doubted; larger: fewer ghosts, less detail",
    )
    support_radius: float = parameter(
        1.0e-3,
        unit="m",
        minimum=1.0e-4,
        maximum=1.0e-2,
        doc="a neighbouring scan must have seen something this near; smaller: fewer ghosts",
    )
    max_incidence_deg: float = parameter(
        82.0,
        unit="deg",
        minimum=30.0,
        maximum=90.0,
        doc="a view farther from the normal is grazing and doubted; larger: steeper flanks, noisier",
    )
    max_blur: float = parameter(
        2.0,
        minimum=1.0,
        maximum=100.0,
        doc="doubtful points noisier than this many times the stripe's median are dropped; smaller: fewer outliers",
    )


@dataclass(frozen=True)
class AssociationConfig:
    """Window-to-map correspondences, eq. (4)."""

    points_per_scan: int = parameter(
        25,
        unit="points",
        minimum=1,
        maximum=1000,
        doc="stripe points of each scan that look for the map; more: slower, hardly better",
    )
    gate: float = parameter(
        1.0e-3,
        unit="m",
        minimum=1.0e-4,
        maximum=1.0e-2,
        doc="farthest map point that may correspond; larger: captures more drift, wrong edges",
    )
    max_angle_deg: float = parameter(
        60.0, unit="deg", minimum=5.0, maximum=90.0, doc="normals of stripe and map farther apart do not correspond"
    )
    max_colour: float = parameter(
        80.0, unit="grey levels", minimum=1.0, maximum=255.0, doc="colours farther apart, in any channel, do not correspond"
    )
    min_age_scans: int = parameter(
        30, unit="scans", minimum=1, maximum=100000, doc="map points younger than this are not independent of the window"
    )
    min_age_s: float = parameter(
        5.0, unit="s", minimum=0.0, maximum=3600.0, doc="the same, in time; longer: fewer constraints, less self-confirmation"
    )
    min_neighbours: int = parameter(
        6, unit="points", minimum=3, maximum=1000, doc="fewest map points of a plane that constrains; larger: sturdier, fewer"
    )
    sigma_floor: float = parameter(
        1.5e-4,
        unit="m",
        minimum=1.0e-6,
        maximum=1.0e-2,
        doc="point-to-plane sigma that is not in the noise of the points: poses of the map",
    )
    min_constraints: int = parameter(
        30,
        unit="points",
        minimum=1,
        maximum=100000,
        doc="fewer correspondences in a window are not sent: they could be wrong together",
    )


@dataclass(frozen=True)
class MappingConfig:
    """Map, entry of scans, window-to-map association, and what is kept for colour and for viewers."""

    map: MapConfig = section(MapConfig)
    entry: EntryConfig = section(EntryConfig)
    association: AssociationConfig = section(AssociationConfig)
    colour: str = parameter(
        COMPENSATED,
        choices=(COMPENSATED, AS_SEEN),
        doc="colours without the light that travels with the camera, so that passes do not band, or as seen",
    )
    prior_map: str = parameter(
        "", doc="map (.vli) of an earlier session to go on with, relative to the working directory; empty: none"
    )
    image_buffer_s: float = parameter(
        10.0,
        unit="s",
        minimum=0.1,
        maximum=60.0,
        doc="long images wait this long for the poses of their scans; longer: more memory",
    )
    colour_gap_s: float = parameter(
        0.1, unit="s", minimum=0.01, maximum=1.0, doc="a long image farther than this from a scan does not colour it"
    )
    max_published_points: int = parameter(
        500_000, unit="points", minimum=1000, maximum=100_000_000, doc="size of the map topic; the map itself has no limit"
    )
