"""Colour of a map without the light on board: one spot in two passes, and all spots against their albedo; with true poses.

    python test/perf/bench_colour.py [RECORDING ...]

A RECORDING has ``bag``, ``calibration.yaml``, ``truth.tum``, ``passes.json``, ``surface.ply``, and ``seen.ply`` with albedo, as
``vli simulate`` writes them. Each pass makes a map of its own; light and lens are those found by the whole scan. Lines: colours
as in the images, each point corrected by itself, the same with the normals of the surface, and as ``vli run`` writes them.
Figures are RMS of 255: points of the two passes that lie within 0.15 mm of each other, means of such pairs over 0.5 mm, the
pairs by the angle at which the light falls on the true surface; and map points against albedo after one gain a channel. Print is
points of flat places whose true grey level differs by 20 or more from the mean within 0.75 mm; its contrast is the slope of the
shown differences over the true ones, 1 where all of it is kept.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_map import DATA, read_frames, time_with_truth
from plyfile import PlyData
from scipy.spatial import KDTree

from vli_bringup.evaluation_data import read_passes, read_surface
from vli_bringup.map_metrics import sample_surface
from vli_common.arrays import BoolArray, FloatArray, IntArray
from vli_common.calibration import load_calibration
from vli_common.types import Image, LaserScan
from vli_mapping.albedo import albedo
from vli_mapping.light import Light
from vli_mapping.photographs import develop
from vli_mapping.point_map import PointMap
from vli_mapping.warm_up import warm_up

ERROR_M = 3e-5
"""RMS of the slow error of the poses: without any, a map is better than it ever is."""
PAIR_M, SPOT_M, ALBEDO_M = 1.5e-4, 5e-4, 2e-4
PRINT_M, PRINT_LEVEL, FLAT = 7.5e-4, 20.0, float(np.cos(np.radians(15.0)))
ANGLES_DEG = (0.0, 20.0, 40.0, 60.0, 90.0)


@dataclass(frozen=True)
class Pass:
    """The map of one pass: positions, true normals towards the camera (N, 3), angles of the light (N,), albedo (N, 3) of 255."""

    map: PointMap
    position: FloatArray
    normals: FloatArray
    angle_deg: FloatArray
    albedo: FloatArray

    @staticmethod
    def of(point_map: PointMap, light: Light, data: Path) -> Pass:
        """Compare a map in the frame of the truth with surface and albedo."""
        c, which = point_map.columns, point_map.alive()
        position, view = c.position[which], point_map.views[c.seen_by[which]]
        samples, normals = sample_surface(read_surface(data / "surface.ply"), KDTree(position))
        normals = normals[KDTree(samples).query(position)[1]]
        normals *= np.sign(np.einsum("ni,ni->n", normals, view[:, :, 3] - position))[:, None]
        towards = view[:, :, :3] @ light.position + view[:, :, 3] - position
        cosine = np.einsum("ni,ni->n", normals, towards) / np.linalg.norm(towards, axis=1)
        angle_deg = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
        return Pass(point_map, position, normals, angle_deg, true_albedo(data / "seen.ply", position))

    def by_true_normals(self, light: Light) -> FloatArray:
        """Return the colours (N, 3), each corrected by itself, with the normals of the surface."""
        c, which = self.map.columns, self.map.alive()
        view = self.map.views[c.seen_by[which]]
        local = np.einsum("nji,nj->ni", view[:, :, :3], self.position - view[:, :, 3])
        turned = np.einsum("nji,nj->ni", view[:, :, :3], self.normals)
        result: FloatArray = c.colour[which] / light.shading(local, turned)[:, None]
        return result

    def error_to_albedo(self, colours: FloatArray) -> float:
        """Return the RMS against the albedo, of 255, after the best gain of each channel."""
        known = np.isfinite(self.albedo).all(axis=1) & np.isfinite(colours).all(axis=1)
        shown, true = colours[known], self.albedo[known]
        return rms(best_gain(shown, true) * shown - true)

    def print_contrast(self, colours: FloatArray) -> float:
        """Return how much of the contrast of print (1 = all) the colours keep, after the best gain of each channel."""
        known = np.isfinite(self.albedo).all(axis=1) & np.isfinite(colours).all(axis=1)
        position, normals, shown, true = self.position[known], self.normals[known], colours[known], self.albedo[known]
        pairs = KDTree(position).query_pairs(PRINT_M, output_type="ndarray")
        bent = np.einsum("ni,ni->n", normals[pairs[:, 0]], normals[pairs[:, 1]]) < FLAT
        is_flat = np.ones(len(position), np.bool_)
        is_flat[pairs[bent].ravel()] = False
        of_true, of_shown = (details(item.mean(axis=1), pairs) for item in (true, best_gain(shown, true) * shown))
        is_print = is_flat & (np.abs(of_true) >= PRINT_LEVEL)
        return float((of_shown * of_true)[is_print].sum() / (of_true[is_print] ** 2).sum()) if is_print.any() else np.nan


def true_albedo(seen: Path, position: FloatArray) -> FloatArray:
    """Return the albedo (N, 3), of 255, of the nearest seen point; NaN where none is near."""
    vertex = PlyData.read(seen)["vertex"]
    known = np.stack([vertex[f"albedo_{name}"] for name in ("red", "green", "blue")], axis=1).astype(np.float64)
    distance, nearest = KDTree(np.stack([vertex[name] for name in "xyz"], axis=1)).query(position)
    return np.where((distance < ALBEDO_M)[:, None], known[nearest], np.nan)


def best_gain(shown: FloatArray, true: FloatArray) -> FloatArray:
    """Return the factors (3,) by which shown colours (N, 3) come nearest to the true ones."""
    result: FloatArray = (shown * true).sum(axis=0) / (shown**2).sum(axis=0)
    return result


def details(grey: FloatArray, pairs: IntArray) -> FloatArray:
    """Return by how much grey levels (N,) differ from the means over their neighbours; ``pairs`` (M, 2) of these, each once."""
    first, second = np.concatenate([pairs, pairs[:, ::-1]]).T
    count = 1 + np.bincount(first, minlength=len(grey))
    result: FloatArray = grey - (grey + np.bincount(first, grey[second], len(grey))) / count
    return result


def rms(values: FloatArray) -> float:
    """Return the root of the mean square of all that is known."""
    return float(np.sqrt(np.nanmean(values**2)))


def spot_means(difference: FloatArray, position: FloatArray) -> FloatArray:
    """Return the means of differences (N, 3) over the cubes of 0.5 mm that positions (N, 3) lie in."""
    spot = np.unique(np.floor(position / SPOT_M).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
    total = np.stack([np.bincount(spot, column) for column in difference.T], axis=1)
    result: FloatArray = total / np.bincount(spot)[:, None]
    return result


def print_line(name: str, passes: tuple[Pass, Pass], pairs: tuple[IntArray, IntArray], colours: tuple[FloatArray, ...]) -> None:
    """Print the figures of one kind of colour of both passes."""
    shown = [np.clip(item, 0.0, 255.0) for item in colours]
    difference = shown[0][pairs[0]] - shown[1][pairs[1]]
    known: BoolArray = np.isfinite(difference).all(axis=1)
    spots = spot_means(difference[known], passes[0].position[pairs[0]][known])
    angle = np.maximum(passes[0].angle_deg[pairs[0]], passes[1].angle_deg[pairs[1]])
    by_angle = [rms(difference[(angle >= low) & (angle < high)]) for low, high in itertools.pairwise(ANGLES_DEG)]
    to_albedo = np.mean([item.error_to_albedo(colour) for item, colour in zip(passes, shown, strict=True)])
    contrast = np.mean([item.print_contrast(colour) for item, colour in zip(passes, shown, strict=True)])
    print(
        f"{name:24s} pairs {rms(difference):5.1f} (median {np.nanmedian(np.abs(difference)):.1f}), spots {rms(spots):5.1f}; "
        f"by angle {', '.join(f'{value:.1f}' for value in by_angle)}; to albedo {to_albedo:.1f}; "
        f"contrast of print {contrast:.2f}",
        flush=True,
    )


def report(data: Path) -> None:
    """Print the lines of one recording."""
    spans = read_passes(data / "passes.json")[:2].tolist()
    if len(spans) < 2:
        raise SystemExit(f"'{data}' has '{len(spans)}' pass, two are needed; 'vli simulate … --preset short' makes two")
    calibration = load_calibration(data / "calibration.yaml")
    frames: list[Image | LaserScan] = list(read_frames(data, calibration))
    light = time_with_truth(data, calibration, ERROR_M, frames=frames).mapper.light()
    if light is None:
        raise SystemExit(f"'{data}' tells too little of the light")
    maps = []
    for start, end in spans:
        timed = time_with_truth(data, calibration, ERROR_M, frames=[item for item in frames if start <= item.stamp_ns <= end])
        timed.mapper.settle()
        develop(timed.mapper.map, light, calibration.camera, timed.mapper.photographs())
        maps.append(timed.mapper.map)
    first, second = passes = (Pass.of(maps[0], light, data), Pass.of(maps[1], light, data))
    distance, nearest = KDTree(first.position).query(second.position)
    near = np.flatnonzero(distance < PAIR_M)
    pairs = (nearest[near], near)
    print(f"{data.name}: {len(near)} pairs; {light}")
    every = [item.map.alive() for item in passes]
    kinds = {
        "as in the images": [item.map.columns.colour[rows] for item, rows in zip(passes, every, strict=True)],
        "each by itself": [item.map.shown_colours(rows, light, as_seen=False) for item, rows in zip(passes, every, strict=True)],
        "the same, true normals": [item.by_true_normals(light) for item in passes],
        "albedo": [albedo(item.map, light) for item in passes],
    }
    for name, colours in kinds.items():
        print_line(name, passes, pairs, tuple(colour.astype(np.float64) for colour in colours))
    print_line("truth", passes, pairs, (first.albedo, second.albedo))


def main() -> None:
    """Print the lines of all recordings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, nargs="*", default=[DATA])
    warm_up()
    for recording in parser.parse_args().recordings:
        report(recording)


if __name__ == "__main__":
    main()
