"""How well the pose of a frame is known, against the first pose of the map.

The smoother's prior carries what every keyframe that has left the window knew, so the marginal covariance of the newest
keyframe is that of the whole path behind it: zero at the first pose, which is the gauge, and growing from there. A frame after
the keyframe moves rigidly with it; its own adjustment adds what the features leave open between the two,

    P = Ad(T_frame_keyframe) P_keyframe Ad(T_frame_keyframe)ᵀ + P_frame,

for right perturbations [ω, v] (Barfoot & Furgale, 2014, to first order).
"""

from __future__ import annotations

import numpy as np

from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, skew


def adjoint(T: FloatArray) -> FloatArray:
    """Return Ad (6, 6) of a pose (4, 4): T Exp(ξ) T⁻¹ = Exp(Ad ξ), ξ = [ω, v]."""
    rotation = T[:3, :3]
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = rotation
    result[3:, :3] = skew(T[:3, 3]) @ rotation
    return result


def in_map_axes(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return a covariance (6, 6) of [ω, v] in the body in the order of ROS: position in map, rotation about the axes of map.

    Args:
        covariance: of a right perturbation.
        rotation: (3, 3) body to map.
    """
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = rotation
    result: FloatArray = turn @ covariance @ turn.T
    return result


class PoseCovariance:
    """Carries the covariance of the newest keyframe to the frames after it.

    Args:
        T_imu_cam: (4, 4).
        scale: factor on the variances, see ``BackEndConfig.covariance_scale``.
    """

    def __init__(self, T_imu_cam: FloatArray, scale: float) -> None:
        self._to_body = adjoint(T_imu_cam)
        self._scale = scale
        self._T_map_imu = np.eye(4)
        self._keyframe = np.zeros((6, 6))

    def set_keyframe(self, T_map_imu: FloatArray, covariance: FloatArray) -> None:
        """Take pose (4, 4) and marginal covariance (6, 6), [ω, v] in imu_link, of the newest keyframe."""
        self._T_map_imu, self._keyframe = T_map_imu, covariance

    def of_keyframe(self) -> FloatArray:
        """Return the covariance (6, 6) of the newest keyframe, in the order of ROS."""
        return self._scale * in_map_axes(self._keyframe, self._T_map_imu[:3, :3])

    def of_frame(self, T_map_imu: FloatArray, information: FloatArray) -> FloatArray:
        """Return the covariance (6, 6) of a later frame, in the order of ROS.

        Args:
            T_map_imu: (4, 4).
            information: (6, 6) of the frame's own adjustment, [ω, v] in the camera, keyframe and landmarks held.
        """
        carry = adjoint(inverse(T_map_imu) @ self._T_map_imu)
        own = self._to_body @ np.linalg.inv(information) @ self._to_body.T
        return self._scale * in_map_axes(carry @ self._keyframe @ carry.T + own, T_map_imu[:3, :3])
