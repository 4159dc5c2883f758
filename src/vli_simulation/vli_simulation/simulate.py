"""A whole recording: scene, motion, frames on all cores, IMU; written with its truth."""

from __future__ import annotations

import collections
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from vli_common.arrays import AnyArray, FloatArray, IntArray
from vli_common.calibration import to_yaml
from vli_common.types import NANOSECONDS
from vli_simulation.config import RECORD, SimulationConfig, to_document
from vli_simulation.imu import ImuRecording, record_imu
from vli_simulation.motion import Motion, plan_motion
from vli_simulation.parallel import in_order, single_threaded_opencv
from vli_simulation.render import Renderer, SeenPoints, View
from vli_simulation.rig import Rig, make_rig
from vli_simulation.scenes import make_scene
from vli_simulation.scenes.scene import Scene
from vli_simulation.sensor import EncodedFrame, Sensor
from vli_simulation.writer import BagWriter, write_passes, write_ply, write_tum

_SEEN_SPACING = 0.25e-3
_CELL_OFFSET = 1 << 20
"""Makes cell numbers positive within 262 m of the origin."""
_SEEN_TYPE = [
    *((name, "f4") for name in "xyz"),
    *((name, "u1") for name in ("red", "green", "blue", "albedo_red", "albedo_green", "albedo_blue")),
]
_SURFACE_TYPE = [*((name, "f8") for name in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]


@dataclass(frozen=True)
class Frame:
    """One rendered frame; ``seen`` is None for a long one."""

    index: int
    stamp_ns: int
    image: EncodedFrame
    seen: SeenPoints | None


class Simulation:
    """Everything about a recording that can be known before its frames are rendered; frames may be rendered in any order."""

    def __init__(self, scene: str, config: SimulationConfig, seed: int) -> None:
        self.config, self.seed = config, seed
        self.scene: Scene = make_scene(scene, seed)
        self.rig: Rig = make_rig(config, seed)
        self.motion: Motion = plan_motion(config.motion, self.scene.path, self.rig, config.rig.stripe_angle_deg, seed)
        self.renderer = Renderer(self.scene, self.rig, config, seed)
        self.sensor = Sensor(config.sensor, config.rig.height, config.rig.width, seed)
        self.start_ns = config.start_s * NANOSECONDS
        count = round(config.motion.duration_s * config.rig.rate_hz)
        self.offsets_ns: IntArray = np.round(np.arange(count) * (NANOSECONDS / config.rig.rate_hz)).astype(np.int64)
        times = self.offsets_ns / NANOSECONDS
        self.poses: FloatArray = self.motion.trajectory.camera_poses(times)
        self._velocities, self._rates = self.motion.trajectory.camera_twists(times)

    def __len__(self) -> int:
        return len(self.offsets_ns)

    @property
    def stamps_ns(self) -> IntArray:
        """Mid-exposure of every frame (N,)."""
        return self.offsets_ns + self.start_ns

    def view(self, index: int) -> View:
        """Return the camera's true state at a frame, rounded to 12 decimals: at rest, equal views are then equal to the bit."""
        return View(*(np.round(values[index], 12) for values in (self.poses, self._velocities, self._rates)))

    def frame(self, index: int) -> Frame:
        """Render one frame; even ones are long. Its noise depends on seed and index only."""
        rng = np.random.default_rng([self.seed, 6, index])
        view, laser_on = self.view(index), bool(index % 2)
        light = self.renderer.short_frame(view, rng) if laser_on else self.renderer.long_frame(view)
        image = self.sensor.encode(self.sensor.expose(light, rng))
        return Frame(index, int(self.stamps_ns[index]), image, self.renderer.seen(view) if laser_on else None)

    def frames(self, workers: int | None) -> Iterator[Frame]:
        """Yield all frames in order, rendered by ``workers`` threads a few frames ahead."""
        return in_order(self.frame, len(self), workers)

    def imu(self) -> ImuRecording:
        """Return the IMU's recording."""
        return record_imu(self.motion.trajectory, self.config.imu, self.start_ns, self.config.motion.duration_s, self.seed)

    @property
    def path_length(self) -> float:
        """Metres that the camera travels, tremor included, from frame to frame."""
        return float(np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1).sum())


class SeenCloud:
    """Collects what the laser saw, thinned: the first point in each cube of 0.25 mm stays."""

    def __init__(self) -> None:
        self._cells: set[int] = set()
        self._parts: list[AnyArray] = []

    def add(self, points: FloatArray, colour: AnyArray, albedo: AnyArray) -> None:
        """Add points (N, 3) with colour and albedo (N, 3) uint8, blue green red."""
        cells = np.floor(points / _SEEN_SPACING).astype(np.int64) + _CELL_OFFSET
        keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
        first = np.sort(np.unique(keys, return_index=True)[1])
        fresh = [n for n in first if int(keys[n]) not in self._cells]
        self._cells.update(int(key) for key in keys[fresh])
        rows = np.empty(len(fresh), _SEEN_TYPE)
        for axis, name in enumerate("xyz"):
            rows[name] = points[fresh, axis]
        for channel, name in enumerate(("blue", "green", "red")):
            rows[name], rows[f"albedo_{name}"] = colour[fresh, channel], albedo[fresh, channel]
        self._parts.append(rows)

    def rows(self) -> AnyArray:
        """Return all points as a structured array."""
        return np.concatenate(self._parts) if self._parts else np.empty(0, _SEEN_TYPE)


def write_recording(
    simulation: Simulation, out: Path, workers: int | None = None, progress: Callable[[int], object] | None = None
) -> None:
    """Render everything into the directory ``out``, which exists.

    Args:
        simulation: what to record.
        out: gets bag, calibration.yaml, truth.tum, surface.ply, seen.ply, passes.json, simulation.yaml.
        workers: threads; all cores by default. The result does not depend on it.
        progress: called with the number of frames done since the last call.
    """
    (out / "calibration.yaml").write_text(to_yaml(simulation.rig.document))
    (out / RECORD).write_text(yaml.safe_dump({"seed": simulation.seed, **to_document(simulation.config)}, sort_keys=False))
    write_tum(out / "truth.tum", (int(stamp) for stamp in simulation.stamps_ns), simulation.poses)
    start_s = simulation.config.start_s
    passes = [(start_s + start, start_s + end) for start, end in simulation.motion.passes]
    write_passes(out / "passes.json", simulation.path_length, passes)
    _write_surface(simulation, out / "surface.ply")
    seen = _write_bag(simulation, out / "bag", workers, progress)
    write_ply(
        out / "seen.ply", "what the laser saw, thinned to 0.25 mm; colour as lit, noise-free; albedo beside it", seen.rows()
    )


def _write_bag(simulation: Simulation, path: Path, workers: int | None, progress: Callable[[int], object] | None) -> SeenCloud:
    config, seen = simulation.config, SeenCloud()
    compressed = config.sensor.encoding in ("jpeg", "bayer-png")
    with (
        single_threaded_opencv(),
        BagWriter(path, simulation.rig, config.imu, compressed, config.exposure_topic) as bag,
    ):
        samples = collections.deque(simulation.imu())
        for frame in simulation.frames(workers):
            while samples and samples[0].stamp_ns <= frame.stamp_ns:
                bag.add_imu(samples.popleft())
            laser_on = frame.seen is not None
            exposure = config.sensor.exposure_short_s if laser_on else config.sensor.exposure_long_s
            bag.add_frame(frame.stamp_ns, frame.image, exposure, laser_on)
            if frame.seen is not None:
                colour = simulation.sensor.ideal(frame.seen.light)
                seen.add(frame.seen.points, colour, np.clip(np.round(255 * frame.seen.albedo), 0, 255).astype(np.uint8))
            if progress:
                progress(1)
        for sample in samples:
            bag.add_imu(sample)
    return seen


def _write_surface(simulation: Simulation, path: Path) -> None:
    mesh, vertices = simulation.scene.mesh, simulation.renderer.caster.vertices
    rows = np.zeros(len(vertices), _SURFACE_TYPE)
    for axis, name in enumerate("xyz"):
        rows[name] = vertices[:, axis]
    albedo = np.array([material.albedo for material in simulation.scene.materials])
    colour = np.zeros((len(vertices), 3))
    colour[mesh.faces.ravel()] = np.repeat(albedo[mesh.material], 3, axis=0)
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = np.round(255 * colour[:, channel])
    write_ply(path, "the scanned surface, metres", rows, mesh.faces)
