"""The light that travels with the camera, estimated from the scan itself, so that it can be taken out of the colours.

What a pixel shows of a surface of albedo ρ is ρ · E, E = (cos β · cos γ · (r₀ / r)² + a) · V: β is between the normal and the
direction to the light, γ between the axis of the camera and the ray of light (a Lambertian emitter that looks along the axis), r
the distance to the light, a the ambient share, V = 1 − v₁ t² − v₂ t⁴ the vignetting of the lens, t the tangent of the angle to
the axis. A spot seen in several long images has one ρ: the ratios of its grey levels give the light's place, a and V without it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vli_common.arrays import FloatArray, IntArray

MIN_SPOTS = 200
"""Fewer spots say too little of the light: colours stay as seen."""
_MAX_SPOTS = 3000
_MIN_SHADING = 0.06
"""Of the reference: what got less light is amplified no further, it would be noise."""
_UNKNOWN_COSINE = 0.7
"""Of a point that has no normal: between a surface that faces the light and the flank of a key."""
_LOG_SIGMA = 0.1
"""Of the logarithm of a grey level; what deviates more is hidden, a shadow, a highlight or blurred, and counts less."""
_PRIOR = np.array([0.0, 0.0, 0.0, 0.05, 0.2, 0.0])
_PRIOR_SIGMA = np.array([0.02, 0.02, 0.02, 0.03, 0.2, 0.1])
"""Light within some cm of the lens, ambient share, v₁ and v₂: they rule only what the scan says nothing of."""
_PRIOR_WEIGHT = 5.0
_LOWEST, _HIGHEST = np.array([-0.1, -0.1, -0.1, 0.0, 0.0, -0.3]), np.array([0.1, 0.1, 0.019, 1.0, 0.8, 0.3])


@dataclass(frozen=True, slots=True)
class Light:
    """Light and lens of one scan, in the camera frame.

    Args:
        position: (3,), of the light, metres.
        ambient: share of the light that comes from everywhere, of the direct one at the reference.
        vignetting: (2,), v₁ and v₂ above.
        reference_m: a surface that faces the camera on its axis at this distance has shading 1.
    """

    position: FloatArray
    ambient: float
    vignetting: tuple[float, float]
    reference_m: float

    def shading(self, points: FloatArray, normals: FloatArray) -> FloatArray:
        """Return E (N,) relative to the reference, at least a small share of it.

        Args:
            points: (N, 3), camera frame, metres.
            normals: (N, 3), camera frame, unit; 0 = unknown.
        """
        parameters = np.array([*self.position, self.ambient, *self.vignetting])
        axis = np.array([[0.0, 0.0, self.reference_m]])
        reference = irradiance(parameters, axis, np.array([[0.0, 0.0, -1.0]]), self.reference_m)
        result: FloatArray = np.maximum(irradiance(parameters, points, normals, self.reference_m) / reference, _MIN_SHADING)
        return result

    def vignette(self, points: FloatArray) -> FloatArray:
        """Return V (N,) for points (N, 3) in the camera frame."""
        return _vignette(*self.vignetting, points)


def irradiance(parameters: FloatArray, points: FloatArray, normals: FloatArray, reference_m: float) -> FloatArray:
    """Return E (N,) of the module's equation.

    Args:
        parameters: (6,), place of the light (m), a, v₁, v₂.
        points: (N, 3), camera frame, metres.
        normals: (N, 3), unit, 0 where unknown.
        reference_m: r₀.
    """
    x, y, z = (points - parameters[:3]).T
    squared = x * x + y * y + z * z
    distance = np.sqrt(squared)
    towards = -(normals[:, 0] * x + normals[:, 1] * y + normals[:, 2] * z) / distance
    known = normals.any(axis=1)
    facing = np.where(known, np.maximum(towards, 0.0), _UNKNOWN_COSINE)
    emitted = np.maximum(z / distance, 0.0)
    lens = _vignette(parameters[4], parameters[5], points)
    result: FloatArray = (facing * emitted * reference_m**2 / squared + parameters[3]) * lens
    return result


def _vignette(first: float, second: float, points: FloatArray) -> FloatArray:
    tangent2 = (points[:, 0] ** 2 + points[:, 1] ** 2) / points[:, 2] ** 2
    result: FloatArray = np.maximum(1.0 - first * tangent2 - second * tangent2**2, 0.1)
    return result


@dataclass(frozen=True, slots=True)
class Sightings:
    """Spots as several long images show them; M rows, those of a spot together.

    Args:
        spot: (M,) int64, which spot.
        level: (M,) grey level.
        points: (M, 3) and normals (M, 3) of the spot in the camera frame of the image.
    """

    spot: IntArray
    level: FloatArray
    points: FloatArray
    normals: FloatArray


class LightEstimator:
    """Collects spots over a whole scan, a bounded number, and fits the light to them when it is asked for.

    Args:
        latest: what is known already.
    """

    def __init__(self, latest: Light | None = None) -> None:
        self._chunks: list[Sightings] = []
        self.spots = 0
        """Kept, of those that were offered."""
        self._offered = self._lots = 0
        self._stride = 1
        self._fitted = 0
        self.latest = latest
        """As of the last fit."""

    def is_due(self) -> bool:
        """Count a lot that could be added; return False where it is to be left out."""
        self._offered += 1
        return self._offered % self._stride == 0

    def add(self, sightings: Sightings) -> None:
        """Take a lot of spots; once there are enough, every second lot goes, so that they are spread over the whole scan."""
        if not len(sightings.spot):
            return
        self._lots += 1
        self._chunks.append(sightings)
        self.spots += _count(sightings)
        if self.spots > _MAX_SPOTS:
            self._chunks = self._chunks[::2]
            self._stride *= 2
            self.spots = sum(_count(chunk) for chunk in self._chunks)

    def fit(self) -> Light | None:
        """Return the light by all spots so far, or None while these are too few."""
        return self.pending()()

    def pending(self) -> Callable[[], Light | None]:
        """Return the fit to all spots so far, see :meth:`fit`, as a call for any thread: it takes a tenth of a second."""
        if self.spots < MIN_SPOTS or self._lots == self._fitted:
            return lambda: self.latest
        lots, sightings = self._lots, _joined(self._chunks)

        def fit() -> Light:
            self.latest, self._fitted = fit_light(sightings), lots
            return self.latest

        return fit


def fit_light(sightings: Sightings) -> Light:
    """Return the light that explains best, robustly, how grey levels of the same spot differ from view to view."""
    from scipy.optimize import least_squares

    reference_m = _round_distance(float(np.median(sightings.points[:, 2])))
    starts = np.flatnonzero(np.diff(sightings.spot, prepend=-1))
    counts = np.diff(starts, append=len(sightings.spot))
    level = np.log(sightings.level)

    def residuals(parameters: FloatArray) -> FloatArray:
        log_albedo = level - np.log(irradiance(parameters, sightings.points, sightings.normals, reference_m) + 1e-6)
        mean = np.add.reduceat(log_albedo, starts) / counts
        prior = _PRIOR_WEIGHT * (parameters - _PRIOR) / _PRIOR_SIGMA
        return np.concatenate([(log_albedo - np.repeat(mean, counts)) / _LOG_SIGMA, prior])

    found = least_squares(residuals, _PRIOR, bounds=(_LOWEST, _HIGHEST), loss="soft_l1", x_scale=_PRIOR_SIGMA, max_nfev=30).x
    return Light(found[:3], float(found[3]), (float(found[4]), float(found[5])), reference_m)


def _round_distance(metres: float) -> float:
    """Return the nearest of 20, 28, 40, 57 … mm: two scans of one thing have the same reference."""
    return float(0.02 * 2 ** (round(2 * np.log2(metres / 0.02)) / 2))


def _count(sightings: Sightings) -> int:
    return int(np.count_nonzero(np.diff(sightings.spot, prepend=-1)))


def _joined(chunks: list[Sightings]) -> Sightings:
    """Return all lots as one, spots numbered anew."""
    spots = [np.cumsum(np.diff(chunk.spot, prepend=-1) != 0) for chunk in chunks]
    firsts = np.cumsum([0, *(int(spot[-1]) for spot in spots)])
    return Sightings(
        np.concatenate([spot + first for spot, first in zip(spots, firsts, strict=False)]),
        np.concatenate([chunk.level for chunk in chunks]),
        np.concatenate([chunk.points for chunk in chunks]),
        np.concatenate([chunk.normals for chunk in chunks]),
    )
