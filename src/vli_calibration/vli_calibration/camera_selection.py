"""Which lens model: the one that predicts best the images that it has not seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from vli_calibration.bundle import Observation
from vli_calibration.camera_fit import CameraFit, View, fit_camera
from vli_calibration.lens import LENSES
from vli_calibration.loo import view_rms
from vli_calibration.progress import progress
from vli_calibration.targets import Target
from vli_common.arrays import FloatArray
from vli_common.errors import InputError

MODEL_CHOICES: dict[str, tuple[str, ...]] = {
    "auto": ("radtan4", "equidistant", "radtan5"),
    "radtan": ("radtan4", "radtan5"),
    "equidistant": ("equidistant",),
}
"""``--model`` → lens models to choose from, fewest parameters first."""


_IMMATERIAL = 0.02


@dataclass(frozen=True, slots=True)
class Candidate:
    """One lens model in the comparison.

    Args:
        model: name in :data:`vli_calibration.lens.LENSES`.
        fit: None where there is none.
        note: why it cannot be chosen, empty where it can.
        predicted_px: geometric mean over the images of the RMS with which the camera of the other images meets their corners;
            NaN where it does not compete.
    """

    model: str
    fit: CameraFit | None
    note: str
    predicted_px: float


@dataclass(frozen=True, slots=True)
class Selection:
    """The fit that was chosen, among what, and why in words."""

    fit: CameraFit
    candidates: tuple[Candidate, ...]
    sentence: str


def select_camera(views: Sequence[View], target: Target, resolution: tuple[int, int], choice: str = "auto") -> Selection:
    """Fit the models of a choice and return the one to use.

    Each image's corners are held against the camera of all other images, only the board's pose being fitted. All models are
    judged by the same corners of the same images: those that any of them kept, so that none gains by throwing out the corners
    that speak against it. Errors are compared image by image, as logarithms. The model with the fewest parameters wins that is
    within one standard error of the best (Breiman's rule), or within 2 %. A model whose distortion folds the
    image over itself is out.

    Args:
        views: corners by image.
        target: whose points they are.
        resolution: width and height, pixels.
        choice: key of :data:`MODEL_CHOICES`.

    Raises:
        InputError: no model fits; see :func:`vli_calibration.camera_fit.fit_camera`.
    """
    models = MODEL_CHOICES[choice]
    fits: dict[str, CameraFit] = {}
    notes: dict[str, str] = {}
    for model in progress(models, len(models), "fitting lens models"):
        try:
            fits[model] = fit_camera(views, target, resolution, model)
        except InputError as error:
            notes[model] = str(error)
    if not fits:
        raise InputError(notes[models[0]])
    notes |= {model: "folds the image over itself" for model, fit in fits.items() if not fit.camera.is_invertible()}
    able = {model: fit for model, fit in fits.items() if model not in notes}
    if not able:
        raise InputError(f"the distortion of '{', '.join(fits)}' folds the image over itself; take views that reach its corners")
    errors = _left_out_errors(able, target)
    chosen = _simplest_of_the_best(errors)
    predicted = {model: float(np.exp(np.log(error).mean())) for model, error in errors.items()}
    candidates = tuple(
        Candidate(model, fits.get(model), notes.get(model, ""), predicted.get(model, float("nan"))) for model in models
    )
    return Selection(able[chosen], candidates, _sentence(chosen, predicted, notes))


def _left_out_errors(fits: Mapping[str, CameraFit], target: Target) -> dict[str, FloatArray]:
    """Return, for each model, the RMS (V,) in pixels of the images that all models use, each left out in turn."""
    rows = {model: {view.name: i for i, view in enumerate(fit.views)} for model, fit in fits.items()}
    common = [view.name for view in next(iter(fits.values())).views if all(view.name in names for names in rows.values())]
    errors: dict[str, list[float]] = {model: [] for model in fits}
    for name in common:
        views = {model: fit.views[rows[model][name]] for model, fit in fits.items()}
        any_kept = np.any([view.kept for view in views.values()], axis=0).astype(np.float64)
        for model, view in views.items():
            seen = Observation(target.points[view.detection.ids], view.detection.pixels, any_kept)
            turn, _ = cv2.Rodrigues(view.T_cam_board[:3, :3])
            pose = np.concatenate([turn.ravel(), view.T_cam_board[:3, 3]])
            errors[model].append(view_rms(LENSES[model], fits[model].loo.parameters[rows[model][name]], pose, seen))
    return {model: np.maximum(error, 1e-6) for model, error in errors.items()}


def _simplest_of_the_best(errors: Mapping[str, FloatArray]) -> str:
    logs = {model: np.log(error) for model, error in errors.items()}
    best = min(logs, key=lambda model: float(logs[model].mean()))
    difference = {model: log - logs[best] for model, log in logs.items()}
    tied = [d for d in logs if difference[d].mean() <= max(difference[d].std(ddof=1) / np.sqrt(len(difference[d])), _IMMATERIAL)]
    return min(tied, key=lambda model: (len(LENSES[model].parameters), float(logs[model].mean())))


def _sentence(chosen: str, predicted: Mapping[str, float], notes: Mapping[str, str]) -> str:
    others = []
    for model, value in predicted.items():
        if model != chosen:
            change = 100 * (value / predicted[chosen] - 1)
            others.append(f"{model} to {value:.3f} px ({abs(change):.0f} % {'worse' if change > 0 else 'better, within chance'})")
    others += [f"{model} is out ({note})" for model, note in notes.items()]
    rest = f"; {'; '.join(others)}" if others else ""
    return f"{chosen} predicts images left out to {predicted[chosen]:.3f} px{rest}"
