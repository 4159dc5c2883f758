"""Intervals of the calibrated plane by bootstrap over the images.

Points of one image err together (its board's pose, its paper), so images are drawn, not points. With a dozen images a percentile
bootstrap is too narrow; the wild cluster bootstrap-t (Cameron, Gelbach & Miller 2008) keeps all images in each draw, flips the
signs of their scores and studentises. Each draw is a linear re-solution of the reduced normal equations.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vli_calibration.laser_joint import ReducedSystem, solve_reduced
from vli_common.arrays import FloatArray

DRAWS = 1999
_SEED = 11
_LEAST_QUANTILE = 1.96
_CONFIDENCE = 0.95


def simultaneous_half_widths(systems: Sequence[ReducedSystem], outputs: FloatArray, draws: int = DRAWS) -> FloatArray:
    """Return half-widths (Q,) of intervals that hold all outputs at once with 95 %.

    Scores are corrected for what each view's own leverage hides (CR3, the jackknife's), and no interval is narrower than the
    noise model of the normal equations makes it.

    Args:
        systems: of each view at the solution.
        outputs: (Q, P) derivative of what is wanted by the shared parameters.
        draws: of the bootstrap.
    """
    hessians = np.stack([system.hessian for system in systems])
    scores = np.stack([system.gradient for system in systems])
    total = hessians.sum(axis=0)
    gain = solve_reduced(total, np.eye(len(total)))
    leverage = np.eye(len(total)) - hessians @ gain
    corrected = np.stack([np.linalg.lstsq(a, s, rcond=None)[0] for a, s in zip(leverage, scores, strict=True)])
    influence = corrected @ (outputs @ gain).T
    noise = np.einsum("qp,pr,qr->q", outputs, gain, outputs)
    error = np.sqrt(np.maximum((influence**2).sum(axis=0), noise))
    signs = np.random.default_rng(_SEED).choice([-1.0, 1.0], (draws, len(systems)))
    shifts = -(signs @ corrected) @ gain.T
    redrawn = signs[:, :, None] * corrected + np.einsum("vpr,br->bvp", hessians, shifts)
    spread = np.sqrt(((redrawn @ (outputs @ gain).T) ** 2).sum(axis=1))
    studentised = np.abs(shifts @ outputs.T) / np.maximum(spread, np.finfo(np.float64).tiny)
    quantile = float(np.quantile(studentised.max(axis=1), _CONFIDENCE))
    half_widths: FloatArray = max(quantile, _LEAST_QUANTILE) * error
    return half_widths
