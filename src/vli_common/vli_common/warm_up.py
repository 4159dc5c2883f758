"""Compiles the kernels that every stage shares."""

from __future__ import annotations

import numpy as np

from vli_common import geometry
from vli_common.camera import make_camera


def warm_up() -> None:
    """Call every kernel once; fast where the compiled code is in numba's cache."""
    T = np.eye(4)
    geometry.so3_log(geometry.so3_exp(np.zeros(3)))
    geometry.inverse(geometry.orthonormalised(geometry.interpolate(T, T, 0.5)))
    geometry.quaternion_from_rotation(T[:3, :3])
    camera = make_camera("radtan", (100.0, 100.0, 64.0, 48.0), (0.0, 0.0, 0.0, 0.0), (128, 96))
    camera.to_pixels(camera.unproject(np.zeros((1, 2))))
