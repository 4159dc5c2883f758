"""Matches of an image with points of the map: how far off a pose puts them, and which pose puts them right.

Errors are judged in pixels of the image in which corners were found, where their noise is the same all over. On the plane of rays
it is not: away from the axis of a fisheye it is several times as wide, and wider radially than tangentially.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vli_common.arrays import BoolArray, FloatArray, IntArray
from vli_common.geometry import inverse, pose, skew, so3_exp, transform

TOLERANCE_PX = 2.0
"""Of a match: poses of the window and of the map, and the place of a corner."""
_SIGMA_PX = 1.0
"""Of a match: the corner, and where the map has it."""
_COPIES = 4.0
"""Matches whose errors are one error: a corner is seen in several views, and remembered by several keyframes."""
MIN_MATCHES = 8
_MINIMAL = 4
"""Three points give up to four poses, one more tells which."""
_HYPOTHESES, _BATCH, _CONFIDENCE = 200, 25, 0.99
_REFINEMENTS = 5


@dataclass(frozen=True, slots=True)
class Matches:
    """Features of an image and the points of the map that they match.

    Args:
        points: (M, 3), map.
        rays: (M, 2), undistorted, normalised.
        px_per_ray: (M, 2, 2), d pixel / d ray of the image in which the corners were found.
    """

    points: FloatArray
    rays: FloatArray
    px_per_ray: FloatArray

    def __len__(self) -> int:
        return len(self.points)

    def at(self, which: IntArray | BoolArray) -> Matches:
        """Return some of the matches."""
        return Matches(self.points[which], self.rays[which], self.px_per_ray[which])


def joined(parts: list[Matches]) -> Matches:
    """Return the matches of all parts, in order; at least one part."""
    return Matches(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.rays for part in parts]),
        np.concatenate([part.px_per_ray for part in parts]),
    )


def errors_px(matches: Matches, local: FloatArray) -> FloatArray:
    """Return the reprojection errors (..., M, 2), to first order, of points (..., M, 3) in the camera; infinite behind it."""
    ahead = local[..., 2:] > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        off = matches.rays - local[..., :2] / local[..., 2:]
        error = np.einsum("mij,...mj->...mi", matches.px_per_ray, off)
    result: FloatArray = np.where(ahead, error, np.inf)
    return result


def normal_equations(
    matches: Matches, T_session_camera: FloatArray, T_map_session: FloatArray, centre: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return matrix (6, 6) and vector (6,) of the reprojection errors, reweighted: matches are many, and some are wrong.

    Args:
        matches: M of them.
        T_session_camera: (M, 4, 4), of the view of each.
        T_map_session: (4, 4), what is sought; see :func:`moved`.
        centre: (3,), about which the session turns.
    """
    T_camera_map = inverse(T_map_session @ T_session_camera)
    local = transform(T_camera_map, matches.points)
    ahead = local[:, 2] > 0
    error = errors_px(matches, local)[ahead]
    x, y, z = local[ahead].T
    zero = np.zeros_like(z)
    projection = np.stack([np.stack([1 / z, zero, -x / z**2], axis=1), np.stack([zero, 1 / z, -y / z**2], axis=1)], axis=1)
    turn = T_camera_map[ahead, :3, :3]
    # The session moves, so the map moves the other way as the camera sees it.
    shift = np.concatenate([turn @ skew(matches.points[ahead] - centre), -turn], axis=2)
    jacobian = matches.px_per_ray[ahead] @ projection @ shift
    weight = 1.0 / (1.0 + (error**2).sum(axis=1) / _SIGMA_PX**2) ** 2 / (_SIGMA_PX**2 * _COPIES)
    weighted = jacobian * weight[:, None, None]
    return np.einsum("nij,nik->jk", weighted, jacobian), np.einsum("nij,ni->j", weighted, error)


def moved(T_map_session: FloatArray, matrix: FloatArray, vector: FloatArray, centre: FloatArray) -> FloatArray:
    """Return a pose (4, 4) moved by the solution of normal equations: turned about ``centre`` (3,), then shifted."""
    delta = np.asarray(np.linalg.lstsq(matrix, vector, rcond=1e-12)[0], np.float64)
    motion = pose(so3_exp(delta[:3]), np.zeros(3))
    motion[:3, 3] = centre - motion[:3, :3] @ centre + delta[3:]
    return motion @ T_map_session


def resect(matches: Matches) -> FloatArray | None:
    """Return T_map_camera (4, 4) of one image by RANSAC, scored as MSAC (Torr and Zisserman, 2000); None without one.

    OpenCV's own judges all rays by one limit.
    """
    if len(matches) < MIN_MATCHES:
        return None
    rng = np.random.default_rng(0)
    best, best_score, tried, needed = np.eye(4), 0.0, 0, float(_HYPOTHESES)
    while tried < needed:
        samples = rng.random((_BATCH, len(matches))).argpartition(_MINIMAL, axis=1)[:, :_MINIMAL]
        poses = _minimal_poses(matches, samples)
        tried += _BATCH
        if not len(poses):
            continue
        scores = _scores(matches, poses)
        if scores.max() > best_score:
            best, best_score = poses[scores.argmax()], float(scores.max())
            share = min(best_score / len(matches), 0.999)
            needed = min(needed, np.log(1 - _CONFIDENCE) / np.log(1 - share**_MINIMAL))
    if best_score <= 0.0:
        return None
    T = _refined(matches, inverse(best))
    close = np.linalg.norm(errors_px(matches, transform(inverse(T), matches.points)), axis=1) < TOLERANCE_PX
    return T if close.sum() >= MIN_MATCHES and np.isfinite(T).all() else None


def _minimal_poses(matches: Matches, samples: IntArray) -> FloatArray:
    """Return T_camera_map (K, 4, 4) of samples (N, 4) of matches; none of those that give no pose."""
    rotations, translations = [np.empty((3, 0))], [np.empty((3, 0))]
    for sample in samples:
        found, rotation, translation = cv2.solvePnP(
            matches.points[sample], matches.rays[sample], np.eye(3), None, flags=cv2.SOLVEPNP_AP3P
        )
        if found:
            rotations.append(np.asarray(rotation, np.float64))
            translations.append(np.asarray(translation, np.float64))
    poses = pose(so3_exp(np.hstack(rotations).T), np.hstack(translations).T)
    result: FloatArray = poses[np.isfinite(poses).all(axis=(1, 2))]
    return result


def _scores(matches: Matches, T_camera_map: FloatArray) -> FloatArray:
    """Return what the matches say of poses (K, 4, 4): (K,), at most the number of matches."""
    local = np.einsum("kij,mj->kmi", T_camera_map[:, :3, :3], matches.points) + T_camera_map[:, None, :3, 3]
    square = (errors_px(matches, local) ** 2).sum(axis=2)
    result: FloatArray = np.maximum(1.0 - square / TOLERANCE_PX**2, 0.0).sum(axis=1)
    return result


def _refined(matches: Matches, T_map_camera: FloatArray) -> FloatArray:
    own = np.broadcast_to(np.eye(4), (len(matches), 4, 4))
    centre = matches.points.mean(axis=0)
    for _ in range(_REFINEMENTS):
        T_map_camera = moved(T_map_camera, *normal_equations(matches, own, T_map_camera, centre), centre)
    return T_map_camera
