"""White noise, bias instability and random walk of a sensor at rest, by maximum likelihood.

Averages over consecutive blocks of T seconds are differenced, which takes the constant bias away. Of white noise of density N
and a bias that walks with density K these differences are exactly a moving average of order one, whose covariance matrix
(tridiagonal, Toeplitz) is diagonal in the discrete sine transform: every transformed value is an independent Gaussian whose
variance is linear in N² and K². So the likelihood is exact and costs one transform. It uses all frequencies with the weights
they deserve, where reading the Allan deviation off at one τ uses one. Bias instability (flicker) joins in Whittle's
approximation, and only where it is significant. A constant drift (warming up) is a nuisance parameter.

Densities as in IEEE Std 952: Allan variance N²/τ + (2 ln 2/π) B² + K² τ/3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import dst
from scipy.optimize import brentq, minimize
from scipy.stats import chi2

from vli_common.arrays import FloatArray

WHITE, FLICKER, WALK = 0, 1, 2
_SIGNIFICANT = 10.0
"""Twice the gain in log likelihood from which the recording needs a flicker component: 1.5 in 1000 by chance."""
_ALIASES = 30
_LEVEL = 0.95
_FAINT = 0.3
"""Of the upper end of its interval: how large a walk is taken to be that was not seen."""
_SPAN = np.log(1e9)
"""Farthest that a variance may lie from the scale of the data, as a logarithm."""


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """Densities of one axis, or of several that share them, each with its 95 % interval (low, high).

    Args:
        white: noise density, unit/√Hz.
        flicker: bias instability B, unit; 0.0 where none is significant.
        walk: random walk, unit/s/√Hz.
        white_interval, flicker_interval, walk_interval: profile likelihood; low is 0.0 where zero cannot be excluded.
        drift: (axes,) mean drift taken out, unit/s.
        drift_sigma: (axes,) its standard deviation.
        duration_s: what was measured.
        block_s: length T of the averages.
    """

    white: float
    flicker: float
    walk: float
    white_interval: tuple[float, float]
    flicker_interval: tuple[float, float]
    walk_interval: tuple[float, float]
    drift: FloatArray
    drift_sigma: FloatArray
    duration_s: float
    block_s: float

    def allan_deviation(self, taus_s: FloatArray) -> FloatArray:
        """Return the Allan deviation of the model at τ (N,)."""
        result: FloatArray = np.sqrt((allan_terms(taus_s) * np.square([self.white, self.flicker, self.walk])).sum(axis=1))
        return result

    def needed_duration_s(self, precision: float) -> float:
        """Return how long a recording determines the walk to ± ``precision`` (a ratio, 95 %), were it as large as it seems."""
        walk = max(self.walk, _FAINT * self.walk_interval[1])
        theta = np.square([self.white, self.flicker, walk])
        blocks = self.duration_s / self.block_s
        while blocks * self.block_s < 1e8:
            spread = _relative_spread(theta, int(blocks), self.block_s, len(self.drift))
            if 1.96 * spread <= precision:
                break
            blocks *= 1.2
        return float(blocks * self.block_s)


def allan_terms(taus_s: FloatArray) -> FloatArray:
    """Return what N², B² and K² contribute to the Allan variance at τ (N,): (N, 3)."""
    taus_s = np.asarray(taus_s, dtype=np.float64)
    return np.stack([1 / taus_s, np.full_like(taus_s, 2 * np.log(2) / np.pi), taus_s / 3], axis=1)


def fit_noise(means: FloatArray, block_s: float) -> NoiseFit:
    """Estimate the densities of axes that share them.

    Args:
        means: (M, axes) averages over consecutive blocks, M ≥ 20, none of them constant.
        block_s: T, seconds.
    """
    spectrum = _Spectrum(means, block_s)
    active = [WHITE, WALK]
    theta = spectrum.maximise(active)
    with_flicker = spectrum.maximise([WHITE, FLICKER, WALK])
    if 2 * (spectrum.cost(theta) - spectrum.cost(with_flicker)) > _SIGNIFICANT:
        active, theta = [WHITE, FLICKER, WALK], with_flicker
    ends = [spectrum.interval(theta, active, index) if index in active else (0.0, 0.0) for index in (WHITE, FLICKER, WALK)]
    white, flicker, walk = map(float, np.sqrt(theta))
    drift, drift_sigma = spectrum.drift(theta)
    return NoiseFit(white, flicker, walk, ends[0], ends[1], ends[2], drift, drift_sigma, len(means) * block_s, block_s)


def spectral_terms(count: int, block_s: float) -> FloatArray:
    """Return the variances (count, 3) that N² = 1, B² = 1 and K² = 1 give the transformed differences of block averages."""
    omega = np.pi * np.arange(1, count + 1) / (count + 1)
    half = 0.5 * omega[:, None] + np.pi * np.arange(-_ALIASES, _ALIASES + 1)
    # The flicker's two-sided spectrum B²/(2π|f|), seen through the average (sinc²), its aliases, and the difference (4 sin²).
    flicker = 4 * np.sin(0.5 * omega) ** 4 * (1 / (half**2 * np.abs(2 * half))).sum(axis=1)
    return np.stack([2 / block_s * (1 - np.cos(omega)), flicker, block_s * (2 + np.cos(omega)) / 3], axis=1)


class _Spectrum:
    """The transformed differences and their likelihood; θ = (N², B², K²)."""

    def __init__(self, means: FloatArray, block_s: float) -> None:
        differences = np.diff(means, axis=0)
        self._z: FloatArray = dst(differences, type=1, axis=0, norm="ortho")
        self._h: FloatArray = dst(np.ones(len(differences)), type=1, norm="ortho")[:, None]
        self._terms = spectral_terms(len(differences), block_s)
        self._block_s = block_s
        # Each component's variance, were it alone: keeps the search near 1.
        self._scale = np.median(self._z**2) / 0.455 / np.median(self._terms, axis=0)

    def cost(self, theta: FloatArray) -> float:
        """Return the negative log likelihood, restricted (REML) to what the drift leaves over."""
        return self._cost(theta)[0]

    def drift(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return each axis' drift and its standard deviation, per second."""
        weight = self._h / (self._terms @ theta)[:, None]
        information = float((weight * self._h).sum())
        drift: FloatArray = (weight * self._z).sum(axis=0) / information / self._block_s
        return drift, np.full(len(drift), information**-0.5 / self._block_s)

    def maximise(self, active: list[int], held: dict[int, float] | None = None, start: FloatArray | None = None) -> FloatArray:
        """Return the most likely θ; components that are neither active nor held are zero."""
        held = held or {}
        free = [index for index in active if index not in held]
        theta = np.zeros(3)
        theta[list(held)] = list(held.values())
        if not free:
            return theta

        def objective(log_ratio: FloatArray) -> tuple[float, FloatArray]:
            theta[free] = self._scale[free] * np.exp(log_ratio)
            cost, gradient = self._cost(theta)
            return cost, gradient[free] * theta[free]

        bounds = [(-_SPAN, _SPAN)] * len(free)
        found = [minimize(objective, guess, jac=True, method="L-BFGS-B", bounds=bounds) for guess in self._guesses(free, start)]
        best = min(found, key=lambda result: float(result.fun))
        theta[free] = self._scale[free] * np.exp(best.x)
        return theta

    def interval(self, theta: FloatArray, active: list[int], index: int) -> tuple[float, float]:
        """Return the 95 % interval of the square root of one component, by its profile likelihood."""
        limit = self.cost(theta) + 0.5 * float(chi2.ppf(_LEVEL, 1))

        def excess(log_ratio: float) -> float:
            held = {index: float(self._scale[index] * np.exp(log_ratio))}
            return self.cost(self.maximise(active, held, theta)) - limit

        peak = float(np.clip(np.log(theta[index] / self._scale[index]), -_SPAN, _SPAN))
        ends = []
        for side in (-1, 1):
            step = 0.02
            while excess(peak + side * step) < 0 and step < 2 * _SPAN:
                step *= 2
            if step >= 2 * _SPAN:
                ends.append(0.0 if side < 0 else np.inf)
                continue
            inner = peak + side * step / 2 if step > 0.02 else peak
            root = brentq(excess, inner, peak + side * step, xtol=1e-4)
            ends.append(float(np.sqrt(self._scale[index] * np.exp(root))))
        return ends[0], ends[1]

    def _guesses(self, free: list[int], start: FloatArray | None) -> list[FloatArray]:
        if start is not None:
            return [np.clip(np.log(np.maximum(start[free], 1e-300) / self._scale[free]), -_SPAN, _SPAN)]
        return [np.where(np.array(free) == WHITE, 0.0, level) for level in (-3.0, -9.0)]

    def _cost(self, theta: FloatArray) -> tuple[float, FloatArray]:
        variance = (self._terms @ theta)[:, None]
        weight = self._h / variance
        information = (weight * self._h).sum()
        residual = self._z - self._h * ((weight * self._z).sum(axis=0) / information)
        axes = self._z.shape[1]
        square = (residual**2).sum(axis=1)[:, None] / variance
        cost = 0.5 * (axes * np.log(variance).sum() + square.sum() + axes * np.log(information))
        slope = 0.5 * (axes - square - axes * weight**2 / information * variance) / variance
        return float(cost), (slope * self._terms).sum(axis=0)


def _relative_spread(theta: FloatArray, count: int, block_s: float, axes: int) -> float:
    """Return the standard deviation of K relative to it that ``count`` blocks will give (Fisher information)."""
    # Few of the modes of a long recording say it all; the sum over them is an integral.
    modes = min(count, 4000)
    terms = spectral_terms(modes, block_s)
    active = theta > 0
    slope = (terms * theta)[:, active] / (terms @ theta)[:, None]
    information = 0.5 * axes * count / modes * slope.T @ slope
    return float(0.5 * np.sqrt(np.linalg.inv(information)[-1, -1]))
