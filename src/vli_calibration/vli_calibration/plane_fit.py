"""The laser plane from where viewing rays of the stripe meet the boards: robust over points, and over whole images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vli_calibration.laser_model import LaserPlane
from vli_common.arrays import FloatArray

DISAGREEING = 3.0
"""An image this many times as far from the plane of all others as images usually are does not belong to them."""

_BESIDE = 6.0
"""Looser for a first look, where few images may fix the plane."""
_LEAST_SHARE = 2 / 3
_ITERATIONS = 30
_TUNING = 4.685
_CONVERGED = 1e-10


def fit_plane(points: FloatArray, weights: FloatArray | None = None) -> LaserPlane:
    """Return the plane that minimises Σ w (n·X + d)² (total least squares).

    Args:
        points: (N, 3), N ≥ 3, not on one line.
        weights: (N,), 1 where None.
    """
    w = np.ones(len(points)) if weights is None else weights
    centre = (w @ points) / w.sum()
    normal = np.linalg.svd(np.sqrt(w)[:, None] * (points - centre), full_matrices=False)[2][2]
    return LaserPlane.from_vector(np.append(normal, -normal @ centre))


def fit_plane_robust(points: FloatArray, weights: FloatArray | None = None) -> LaserPlane:
    """Return the plane of most of the points: iteratively re-weighted with Tukey's biweight at the residuals' own scale."""
    w = np.ones(len(points)) if weights is None else weights
    plane = fit_plane(points, w)
    for _ in range(_ITERATIONS):
        residual = np.abs(plane.distance(points))
        cut = _TUNING * max(1.4826 * float(np.median(residual)), 1e-9)
        previous, plane = plane, fit_plane(points, w * (1 - np.minimum(residual / cut, 1.0) ** 2) ** 2 + 1e-12)
        if np.abs(plane.vector - previous.vector).max() < _CONVERGED:
            break
    return plane


@dataclass(frozen=True)
class ImagePoints:
    """Where the stripe of one image meets its board.

    Args:
        name: of the image.
        points: (M, 3) camera frame.
        sigmas: (M,) of their distance from a plane, metres.
        correlation: number of neighbours that err together.
        sure: the stripe crosses the print, so it lies on the board.
    """

    name: str
    points: FloatArray
    sigmas: FloatArray
    correlation: float = 1.0
    sure: bool = True

    @property
    def weights(self) -> FloatArray:
        """(M,) of the squared distances."""
        return 1 / (self.sigmas**2 * self.correlation)


@dataclass(frozen=True)
class Disagreement:
    """How far one image is from the plane of all the others.

    Args:
        name: of the image.
        size: RMS distance of its points from the others' plane, in their sigmas, over the median of all images.
        distance_m: that RMS distance.
        tilt_rad: by which the image turns the plane.
        shift_m: by which it moves the plane where the points lie.
    """

    name: str
    size: float
    distance_m: float
    tilt_rad: float
    shift_m: float


def fit_images(images: Sequence[ImagePoints]) -> LaserPlane:
    """Return the robust plane of all points of the images, each in its sigmas."""
    return fit_plane_robust(
        np.concatenate([image.points for image in images]), np.concatenate([image.weights for image in images])
    )


def disagreements(images: Sequence[ImagePoints]) -> list[Disagreement]:
    """Compare each image with the plane of all others (leave-one-image-out)."""
    whole = fit_images(images)
    centre = np.concatenate([image.points for image in images]).mean(axis=0)
    raw = []
    for index, image in enumerate(images):
        plane = fit_images([*images[:index], *images[index + 1 :]])
        distance = plane.distance(image.points)
        size = _size(plane, image)
        tilt = float(np.arccos(np.clip(plane.normal @ whole.normal, -1.0, 1.0)))
        shift = abs(float((plane.distance(centre[None]) - whole.distance(centre[None]))[0]))
        raw.append((image.name, size, float(np.sqrt(np.mean(distance**2))), tilt, shift))
    common = float(np.median([size for _, size, *_ in raw]))
    return [Disagreement(name, size / common, *rest) for name, size, *rest in raw]


def agreeing_images(images: Sequence[ImagePoints], least: int) -> tuple[list[ImagePoints], list[Disagreement]]:
    """Return the images whose stripes share a plane, and those left out: the worst first, one at a time.

    An image is left out where it is :data:`DISAGREEING` times as far from the plane of all others as images usually are. At
    least ``least`` images, and two in three, stay.
    """
    kept, out = _beside_the_board(images, least)
    while len(kept) > max(least, int(np.ceil(len(images) * _LEAST_SHARE))):
        worst = max(disagreements(kept), key=lambda found: found.size)
        if worst.size <= DISAGREEING:
            break
        out.append(worst)
        kept = [image for image in kept if image.name != worst.name]
    return kept, out


def _beside_the_board(images: Sequence[ImagePoints], least: int) -> tuple[list[ImagePoints], list[Disagreement]]:
    """Return the images without those whose stripe lies beside the print and off the plane of those that cross it.

    A stripe beside the print may lie on a table under the board; however many such images there are, they have no vote.
    """
    sure = [image for image in images if image.sure]
    if len(sure) < least:
        return list(images), []
    found = disagreements(sure)
    plane = fit_images([image for image, item in zip(sure, found, strict=True) if item.size <= DISAGREEING])
    common = float(np.median([_size(plane, image) for image in sure]))
    out = [
        Disagreement(
            image.name, _size(plane, image) / common, float(np.sqrt(np.mean(plane.distance(image.points) ** 2))), 0.0, 0.0
        )
        for image in images
        if not image.sure and _size(plane, image) > _BESIDE * common
    ]
    names = {item.name for item in out}
    return [image for image in images if image.name not in names], out


def _size(plane: LaserPlane, image: ImagePoints) -> float:
    """Return the RMS distance of an image's points from a plane, in their sigmas."""
    return float(np.sqrt(np.mean((plane.distance(image.points) / image.sigmas) ** 2)))


def spread(images: Sequence[ImagePoints]) -> FloatArray:
    """Return the standard deviations (3,) of all points along their principal axes, metres, largest first.

    A plane is known across a line only as far as the second one reaches beyond the noise of the points.
    """
    points = np.concatenate([image.points for image in images])
    values: FloatArray = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    return values
