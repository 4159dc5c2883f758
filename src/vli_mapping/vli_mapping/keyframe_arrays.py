"""The keyframes of a map as plain arrays, for its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vli_common.arrays import AnyArray
from vli_mapping.features import DESCRIPTOR_BYTES
from vli_mapping.keyframe import MapKeyframe

NAMES = (
    "keyframe_poses",
    "keyframe_depths",
    "keyframe_sizes",
    "keyframe_points",
    "keyframe_descriptors",
    "keyframe_shapes",
    "keyframe_thumbnails",
)
"""Of the arrays: what each keyframe has (K rows), and what the features of all have, end to end (F rows)."""
_FORMS: tuple[tuple[type, tuple[int, ...]], ...] = (
    (np.float64, (4, 4)),
    (np.float64, ()),
    (np.int64, ()),
    (np.float64, (3,)),
    (np.uint8, (DESCRIPTOR_BYTES,)),
    (np.int64, (2,)),
    (np.uint8, ()),
)
_REACH_M = 1e4
_ORTHONORMAL = 1e-6


def pack(keyframes: Sequence[MapKeyframe]) -> dict[str, AnyArray]:
    """Return the arrays of ``NAMES``."""
    values: tuple[list[AnyArray], ...] = (
        [item.T_map_camera[None] for item in keyframes],
        [np.array([item.depth]) for item in keyframes],
        [np.array([len(item)]) for item in keyframes],
        [item.points for item in keyframes],
        [item.descriptors for item in keyframes],
        [np.array([item.thumbnail.shape]) for item in keyframes],
        [item.thumbnail.ravel() for item in keyframes],
    )
    return {
        name: np.concatenate([np.empty((0, *shape), dtype), *parts]).astype(dtype)
        for name, (dtype, shape), parts in zip(NAMES, _FORMS, values, strict=True)
    }


def unpack(arrays: Mapping[str, AnyArray]) -> tuple[MapKeyframe, ...]:
    """Return the keyframes that :func:`pack` made the arrays of.

    Raises:
        ValueError: these are not such arrays.
    """
    for name, (dtype, shape) in zip(NAMES, _FORMS, strict=True):
        if arrays[name].dtype != dtype or arrays[name].ndim < 1 or arrays[name].shape[1:] != shape:
            raise ValueError(f"'{name}' is '{arrays[name].dtype}{list(arrays[name].shape)}'")
    poses, depths, sizes, points, descriptors, shapes, thumbnails = (arrays[name] for name in NAMES)
    if not len(poses) == len(depths) == len(sizes) == len(shapes) or min(sizes.min(initial=0), shapes.min(initial=0)) < 0:
        raise ValueError("its keyframes do not belong together")
    if max(sizes.max(initial=0), len(points)) > len(descriptors) or shapes.max(initial=0) > max(len(thumbnails), 1):
        raise ValueError("its keyframes have more than there is")
    areas = shapes[:, 0] * shapes[:, 1]
    if not (sizes.sum() == len(points) == len(descriptors) and areas.sum() == len(thumbnails)):
        raise ValueError("its keyframes do not belong to their features")
    turns = poses[:, :3, :3]
    rigid = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0) < _ORTHONORMAL
    rigid &= bool((poses[:, 3] == [0.0, 0.0, 0.0, 1.0]).all())
    near = np.abs(poses).max(initial=0.0) < _REACH_M and np.abs(points).max(initial=0.0) < _REACH_M
    if not (rigid and near and (depths > 0).all() and depths.max(initial=0.0) < _REACH_M):
        raise ValueError("its keyframes are nowhere")
    first, start = np.cumsum(sizes) - sizes, np.cumsum(areas) - areas
    return tuple(
        MapKeyframe(
            poses[k],
            float(depths[k]),
            points[first[k] : first[k] + sizes[k]],
            descriptors[first[k] : first[k] + sizes[k]],
            thumbnails[start[k] : start[k] + areas[k]].reshape(shapes[k]),
        )
        for k in range(len(poses))
    )
