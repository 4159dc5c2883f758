"""Clouds with named fields ⇄ types: laser points, tracks, the window, map constraints and the map."""

from __future__ import annotations

import numpy as np
from sensor_msgs.msg import PointCloud2

from vli_common import geometry
from vli_common.arrays import AnyArray, IntArray
from vli_common.errors import MessageError
from vli_common.messages.basics import MAX_SECONDS, from_time, header
from vli_common.messages.pointcloud import cloud_from_rows, cloud_session, pack_rgb, rows_from_cloud, unpack_rgb
from vli_common.messages.poses import rotations_from_quaternions
from vli_common.topics import (
    CAMERA_FRAME,
    CLOUD_FIELDS,
    LASER_POINTS_FIELDS,
    MAP_CONSTRAINTS_FIELDS,
    MAP_FIELDS,
    MAP_FRAME,
    TRACKS_FIELDS,
    WINDOW_FIELDS,
    WindowState,
)
from vli_common.types import (
    NANOSECONDS,
    FrameKind,
    LaserScan,
    MapConstraints,
    PointCloud,
    TrackFlag,
    Tracks,
    WindowPoses,
)

_UNIT_TOLERANCE = 1e-3


def scan_to_message(scan: LaserScan) -> PointCloud2:
    """Return ``laser_points``."""
    rows = np.empty(len(scan), LASER_POINTS_FIELDS)
    _set_columns(rows, "xyz", scan.points)
    _set_columns(rows, "uv", scan.pixels)
    rows["intensity"], rows["sigma"] = scan.intensity, scan.sigma
    return cloud_from_rows(rows, header(scan.stamp_ns, CAMERA_FRAME), scan.session)


def scan_from_message(message: PointCloud2) -> LaserScan:
    """Return the scan of ``laser_points``.

    Raises:
        MessageError: malformed.
    """
    rows = rows_from_cloud(message, LASER_POINTS_FIELDS)
    return LaserScan(
        stamp_ns=from_time(message.header.stamp),
        points=_columns(rows, "xyz"),
        pixels=_columns(rows, "uv"),
        intensity=rows["intensity"].astype(np.float64),
        sigma=rows["sigma"].astype(np.float64),
        session=cloud_session(message, rows),
    )


def tracks_to_message(tracks: Tracks) -> PointCloud2:
    """Return ``tracks``: row 0 is the frame itself."""
    rows = np.zeros(len(tracks) + 1, TRACKS_FIELDS)
    rows["flags"][0] = TrackFlag.KEYFRAME * tracks.keyframe | TrackFlag.STATIONARY * tracks.stationary
    features = rows[1:]
    features["id"], features["flags"] = tracks.ids, tracks.flags
    _set_columns(features, "uv", tracks.pixels)
    _set_columns(features, "xy", tracks.rays)
    _set_columns(features, ("vx", "vy"), tracks.velocity)
    features["sigma"], features["stripe_px"] = tracks.sigma_px, tracks.stripe_px
    return cloud_from_rows(rows, header(tracks.stamp_ns, CAMERA_FRAME), tracks.session)


def tracks_from_message(message: PointCloud2) -> Tracks:
    """Return the tracks of one long frame.

    Raises:
        MessageError: malformed; no row 0; an id twice, or zero.
    """
    rows = rows_from_cloud(message, TRACKS_FIELDS, infinite=("stripe_px",))
    if not len(rows) or rows["id"][0] != 0:
        raise MessageError("tracks have no row 0 with id '0' for the frame itself")
    frame, features = TrackFlag(int(rows["flags"][0])), rows[1:]
    ids: IntArray = features["id"].astype(np.int64)
    if (ids == 0).any() or len(np.unique(ids)) != len(ids):
        raise MessageError("tracks have an id '0' or one id twice")
    return Tracks(
        stamp_ns=from_time(message.header.stamp),
        keyframe=TrackFlag.KEYFRAME in frame,
        stationary=TrackFlag.STATIONARY in frame,
        ids=ids,
        pixels=_columns(features, "uv"),
        rays=_columns(features, "xy"),
        velocity=_columns(features, ("vx", "vy")),
        sigma_px=features["sigma"].copy(),
        stripe_px=features["stripe_px"].copy(),
        flags=features["flags"].copy(),
        session=cloud_session(message, rows),
    )


def window_to_message(window: WindowPoses) -> PointCloud2:
    """Return ``window``."""
    rows = np.empty(len(window), WINDOW_FIELDS)
    _set_stamps(rows, window.stamps)
    rows["kind"] = window.kinds
    place = WindowState.IN if window.located else WindowState.UNLOCATED
    rows["state"] = WindowState.FINAL * window.final | WindowState.REDUNDANT * window.redundant | place
    rows["placement"] = window.placement
    _set_columns(rows, ("px", "py", "pz"), window.T_map_camera[:, :3, 3])
    _set_columns(rows, ("qx", "qy", "qz", "qw"), geometry.quaternion_from_rotation(window.T_map_camera[:, :3, :3]))
    return cloud_from_rows(rows, header(window.stamp_ns, MAP_FRAME), window.session)


def window_from_message(message: PointCloud2) -> WindowPoses:
    """Return the poses of ``window``.

    Raises:
        MessageError: malformed; stamps that do not ascend; an unknown kind; no unit quaternion.
    """
    rows = rows_from_cloud(message, WINDOW_FIELDS)
    stamps = _stamps(rows)
    if (np.diff(stamps) <= 0).any():
        raise MessageError("window has stamps that do not ascend")
    if len(rows) and rows["kind"].max() > max(kind.value for kind in FrameKind):
        raise MessageError(f"window has a frame of kind '{rows['kind'].max()}', expected 0 to {len(FrameKind) - 1}")
    return WindowPoses(
        stamp_ns=from_time(message.header.stamp),
        stamps=stamps,
        kinds=rows["kind"].copy(),
        final=(rows["state"] & WindowState.FINAL) != 0,
        redundant=(rows["state"] & WindowState.REDUNDANT) != 0,
        T_map_camera=geometry.pose(
            rotations_from_quaternions(_columns(rows, ("qx", "qy", "qz", "qw"))), _columns(rows, ("px", "py", "pz"))
        ),
        session=cloud_session(message, rows),
        located=not (rows["state"] & WindowState.UNLOCATED).any(),
        placement=int(rows["placement"][0]) if len(rows) else 0,
    )


def constraints_to_message(constraints: MapConstraints) -> PointCloud2:
    """Return ``map_constraints``."""
    rows = np.empty(len(constraints), MAP_CONSTRAINTS_FIELDS)
    _set_stamps(rows, constraints.scan_stamps)
    _set_columns(rows, ("px", "py", "pz"), constraints.points_camera)
    _set_columns(rows, ("gx", "gy", "gz"), constraints.points_map)
    _set_columns(rows, ("nx", "ny", "nz"), constraints.normals_map)
    rows["sigma"], rows["weight"] = constraints.sigma, constraints.weight
    return cloud_from_rows(rows, header(constraints.stamp_ns, MAP_FRAME), constraints.session)


def constraints_from_message(message: PointCloud2) -> MapConstraints:
    """Return the correspondences of ``map_constraints``.

    Raises:
        MessageError: malformed; a normal that is not unit, sigma that is not positive, weight outside 0 to 1.
    """
    rows = rows_from_cloud(message, MAP_CONSTRAINTS_FIELDS)
    normals = _columns(rows, ("nx", "ny", "nz"))
    if (np.abs(np.linalg.norm(normals, axis=1) - 1) > _UNIT_TOLERANCE).any():
        raise MessageError("map constraints have a normal that is not unit")
    if (rows["sigma"] <= 0).any() or (rows["weight"] < 0).any() or (rows["weight"] > 1).any():
        raise MessageError("map constraints have a sigma that is not positive or a weight outside 0 to 1")
    return MapConstraints(
        stamp_ns=from_time(message.header.stamp),
        scan_stamps=_stamps(rows),
        points_camera=_columns(rows, ("px", "py", "pz")),
        points_map=_columns(rows, ("gx", "gy", "gz")),
        normals_map=normals,
        sigma=rows["sigma"].copy(),
        weight=rows["weight"].copy(),
        session=cloud_session(message, rows),
    )


def cloud_to_message(cloud: PointCloud) -> PointCloud2:
    """Return ``cloud`` (no normals), or ``map`` and ``map_update`` where the cloud has normals and weights."""
    with_normals = cloud.normals is not None and cloud.weights is not None
    rows = np.empty(len(cloud), MAP_FIELDS if with_normals else CLOUD_FIELDS)
    _set_columns(rows, "xyz", cloud.points)
    rows["rgb"] = pack_rgb(cloud.colours)
    if cloud.normals is not None and cloud.weights is not None:
        _set_columns(rows, ("normal_x", "normal_y", "normal_z"), cloud.normals)
        rows["weight"] = cloud.weights
    return cloud_from_rows(rows, header(cloud.stamp_ns, MAP_FRAME), cloud.session)


def cloud_from_message(message: PointCloud2) -> PointCloud:
    """Return the points of ``cloud``, ``map`` or ``map_update``.

    Raises:
        MessageError: malformed.
    """
    with_normals = any(item.name == "normal_x" for item in message.fields)
    rows = rows_from_cloud(message, MAP_FIELDS if with_normals else CLOUD_FIELDS)
    return PointCloud(
        stamp_ns=from_time(message.header.stamp),
        points=_columns(rows, "xyz", np.float32),
        colours=unpack_rgb(rows["rgb"]),
        normals=_columns(rows, ("normal_x", "normal_y", "normal_z"), np.float32) if with_normals else None,
        weights=rows["weight"].copy() if with_normals else None,
        session=cloud_session(message, rows),
    )


def _set_columns(rows: AnyArray, names: str | tuple[str, ...], values: AnyArray) -> None:
    for column, name in enumerate(names):
        rows[name] = values[:, column]


def _columns(rows: AnyArray, names: str | tuple[str, ...], dtype: type = np.float64) -> AnyArray:
    out: AnyArray = np.empty((len(rows), len(names)), dtype)
    for column, name in enumerate(names):
        out[:, column] = rows[name]
    return out


def _set_stamps(rows: AnyArray, stamps: IntArray) -> None:
    if len(stamps) and not 0 <= stamps.min() <= stamps.max() < (MAX_SECONDS + 1) * NANOSECONDS:
        raise MessageError(f"stamps are '{stamps.min()}' to '{stamps.max()}' ns, expected 0 to {MAX_SECONDS} s")
    rows["sec"], rows["nanosec"] = np.divmod(stamps, NANOSECONDS)


def _stamps(rows: AnyArray) -> IntArray:
    if len(rows) and (rows["sec"].max() > MAX_SECONDS or rows["nanosec"].max() >= NANOSECONDS):
        raise MessageError("cloud has a stamp outside 0 to 2³¹ s or a second or more of nanoseconds")
    stamps: IntArray = rows["sec"].astype(np.int64) * NANOSECONDS + rows["nanosec"]
    return stamps
