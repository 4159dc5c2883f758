"""How far right joins of two maps stand apart from wrong ones, by what `vli merge` judges them by.

    python test/perf/bench_merging.py RECORDING HALF HALF [RECORDING HALF HALF ...]

RECORDING has ``truth.tum``; each HALF is what ``vli run`` made of a part of it, with ``--duration`` and ``--start``. The right
join is refined from the true poses. The wrong ones begin elsewhere: one key beside (19 mm along the axes of the truth, or a row
on), at random places and turned half round, and with the second half mirrored. Every half is put to the halves of the other
recordings too. One row each; of the wrong ones that which most speaks for.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from bench_relocalisation import place_of

from vli_bringup.tum import read_tum
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, pose, so3_exp, transform
from vli_mapping.map_file import load_map
from vli_mapping.merging import surface_of_map
from vli_mapping.registration import Registration, Surface, candidates, compare, refine, tree_of
from vli_mapping.thinning import thin_to_voxel

_PITCH_M, _ELSEWHERE_M = 0.01905, 3e-3
_COARSE_M = 1.2e-3
"""Of the points by which wrong joins are refined: there are many of them."""
_RANDOM, _SPREAD_M = 12, 0.02
_MIRROR = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Half:
    """A map of part of a recording, and where it is in the frame of the truth."""

    recording: Path
    scan: Path

    @cached_property
    def surface(self) -> Surface:
        """What is compared."""
        return surface_of_map(load_map(self.scan / "map.vli"))

    @cached_property
    def place(self) -> FloatArray:
        """From all poses of the scan, (4, 4)."""
        return place_of(self.scan, read_tum(self.recording / "truth.tum"))


def mirrored(surface: Surface) -> Surface:
    """Return the surface as a mirror shows it."""
    return Surface(surface.points * _MIRROR, surface.normals * _MIRROR, surface.colours)


def coarse(surface: Surface) -> Surface:
    """Return fewer points of a surface."""
    which = thin_to_voxel(surface.points, np.ones(len(surface.points), np.float32), _COARSE_M)
    return Surface(surface.points[which], surface.normals[which], surface.colours[which])


def join(target: Surface, source: Surface, starts: Iterator[FloatArray], right: FloatArray | None = None) -> Registration | None:
    """Return the join from some starts that most speaks for, but for the right one."""
    few, tree, best = coarse(source), tree_of(target), None
    for start in starts:
        T = refine(target, few, start).T_target_source
        if right is not None and _apart(T, right, few.points) < _ELSEWHERE_M:
            continue
        found = compare(tree, target, source, T)
        best = found if best is None or _claim(found) > _claim(best) else best
    return best


def keys(first: Half, T: FloatArray) -> Iterator[FloatArray]:
    """Yield the right join moved by one key, along and across."""
    for x, y in ((1, 0), (-1, 0), (0.25, 1), (0.5, 1), (-0.25, -1), (-0.5, -1)):
        shift = pose(np.eye(3), _PITCH_M * np.array([x, y, 0.0]))
        yield inverse(first.place) @ shift @ first.place @ T


def anywhere(T: FloatArray, centre: FloatArray, rng: np.random.Generator) -> Iterator[FloatArray]:
    """Yield the right join moved at random, and turned half round every other time."""
    for number in range(_RANDOM):
        turn = so3_exp(np.array([0.0, 0.0, np.pi * (number % 2) + 0.05 * rng.normal()]))
        move = pose(turn, centre - turn @ centre + np.append(rng.uniform(-_SPREAD_M, _SPREAD_M, 2), 0.0))
        yield T @ move


def row(what: str, found: Registration | None) -> None:
    """Print one row of the table."""
    if found is not None:
        verdict = found.doubt or "joined"
        figures = f"{found.overlap} | {found.shape:.3f} | {found.agreeing:.3f} | {found.likeness:.2f}"
        print(f"| {what} | {figures} | {found.score:.0f} | {verdict} |", flush=True)


def _claim(found: Registration) -> tuple[float, float]:
    return found.score, found.overlap * found.agreeing


def _apart(T: FloatArray, other: FloatArray, points: FloatArray) -> float:
    return float(np.linalg.norm(transform(T, points) - transform(other, points), axis=1).mean())


def _brought(T: FloatArray, centre: FloatArray, by: FloatArray) -> FloatArray:
    """Return a transform that brings ``centre`` (3,) to where ``T`` (4, 4) brings ``by`` (3,)."""
    return T @ pose(np.eye(3), by - centre)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", type=Path, metavar="RECORDING HALF HALF")
    sets = parser.parse_args().sets
    if len(sets) % 3:
        raise SystemExit(f"'{len(sets)}' directories, expected a recording and two halves of it, or more such threes")
    halves = [(Half(sets[k], sets[k + 1]), Half(sets[k], sets[k + 2])) for k in range(0, len(sets), 3)]
    print("| join | shared points | same shape | like colours | likeness | score | |\n|---|---|---|---|---|---|---|")
    for first, second in halves:
        name, target, source = first.recording.name, first.surface, second.surface
        T, rng = inverse(first.place) @ second.place, np.random.default_rng(1)
        row(f"{name}: right", join(target, source, iter([T])))
        row(f"{name}: one key beside", join(target, source, keys(first, T), T))
        row(f"{name}: elsewhere", join(target, source, anywhere(T, source.points.mean(axis=0), rng), T))
        glass = mirrored(source)
        beside = _brought(T, glass.points.mean(axis=0), source.points.mean(axis=0))
        row(f"{name}: mirrored", join(target, glass, anywhere(beside, glass.points.mean(axis=0), rng)))
    for first, _ in halves:
        for other, second in halves:
            if other is not first:
                found = candidates(first.surface, second.surface, np.random.default_rng(0))
                row(f"{first.recording.name} + {other.recording.name}", join(first.surface, second.surface, iter(found)))


if __name__ == "__main__":
    main()
