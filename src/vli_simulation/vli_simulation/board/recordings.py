"""The bags: the sensor moving before the board, and its IMU at rest."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vli_common.arrays import FloatArray, IntArray
from vli_common.geometry import inverse
from vli_common.types import NANOSECONDS
from vli_simulation.board.motion import plan_board_motion
from vli_simulation.board.render import Exposures
from vli_simulation.board.simulate import BoardSimulation
from vli_simulation.imu import ImuRecording, record_imu, record_rest
from vli_simulation.parallel import in_order, single_threaded_opencv
from vli_simulation.render import View
from vli_simulation.sensor import EncodedFrame
from vli_simulation.writer import BagWriter, write_tum

_WHITE_GREY = 150.0
_STREAM = 25
_DISTANCE_OF_NEAREST = 1.8
_METERED_VIEWS = 12


class MovingBoard:
    """The recording in which the sensor moves before the board; frames may be rendered in any order."""

    def __init__(self, simulation: BoardSimulation) -> None:
        self._simulation, config = simulation, simulation.config
        near, far = simulation.reach
        motion = plan_board_motion(
            config, simulation.target, simulation.rig, min(_DISTANCE_OF_NEAREST * near, far), simulation.seed
        )
        self.T_world_board: FloatArray = motion.T_world_board
        self._trajectory = motion.trajectory
        rate = config.rig.rate_hz if config.board.alternate else 0.5 * config.rig.rate_hz
        count = round(config.motion.duration_s * rate)
        self.offsets_ns: IntArray = np.round(np.arange(count) * (NANOSECONDS / rate)).astype(np.int64)
        times = self.offsets_ns / NANOSECONDS
        self.poses: FloatArray = motion.trajectory.camera_poses(times)
        """T_world_cam (N, 4, 4)."""
        self._velocities, self._rates = motion.trajectory.camera_twists(times)
        self.exposures = self._metered()

    def __len__(self) -> int:
        return len(self.offsets_ns)

    @property
    def stamps_ns(self) -> IntArray:
        """Mid-exposure of every frame (N,), by the camera's clock."""
        return self.offsets_ns + self._simulation.start_ns

    def is_short(self, index: int) -> bool:
        """Return whether a frame is a short exposure with the laser on."""
        return self._simulation.config.board.alternate and bool(index % 2)

    def view(self, index: int) -> View:
        """Return the camera's state at a frame, in the board's frame; rounded: at rest, equal views are equal to the bit."""
        T_board_cam = inverse(self.T_world_board) @ self.poses[index]
        return View(*(np.round(values, 12) for values in (T_board_cam, self._velocities[index], self._rates[index])))

    def frame(self, index: int) -> EncodedFrame:
        """Render one frame; its noise depends on seed and index only."""
        simulation, view = self._simulation, self.view(index)
        rng = np.random.default_rng([simulation.seed, _STREAM, index])
        if self.is_short(index):
            light = simulation.renderer.short_light(view, self.exposures.short_s, rng, coarse=True)
        else:
            light = simulation.renderer.long_light(view, self.exposures.long_s)
        return simulation.sensor.encode(simulation.sensor.expose(light, rng))

    def imu(self) -> ImuRecording:
        """Return the IMU's recording, stamped by its own clock: t_imu = t_cam + timeshift."""
        simulation, config = self._simulation, self._simulation.config
        recording = record_imu(self._trajectory, config.imu, simulation.start_ns, config.motion.duration_s, simulation.seed)
        shift = round(config.board.time_offset_s * NANOSECONDS)
        return dataclasses.replace(recording, stamps_ns=recording.stamps_ns + shift)

    def _metered(self) -> Exposures:
        """Return the exposures of the whole recording, set once: the median of what single views ask for."""
        indices = np.linspace(0, len(self) - 1, min(_METERED_VIEWS, len(self))).astype(int)
        longest = self._simulation.config.sensor.exposure_long_s
        wanted = [self._simulation.exposures(self.view(int(index)), _WHITE_GREY, longest) for index in indices]
        return Exposures(
            float(np.median([exposure.long_s for exposure in wanted])),
            float(np.median([exposure.short_s for exposure in wanted])),
        )


def write_moving_board(
    simulation: BoardSimulation, moving: MovingBoard, out: Path, workers: int | None, progress: Callable[[int], object]
) -> dict[str, Any]:
    """Write ``bag`` and ``truth.tum`` into a directory; return the rest of the truth."""
    config = simulation.config
    compressed = config.sensor.encoding in ("jpeg", "bayer-png")
    write_tum(out / "truth.tum", (int(stamp) for stamp in moving.stamps_ns), moving.poses)
    imu = moving.imu()
    with (
        single_threaded_opencv(),
        BagWriter(out / "bag", simulation.rig, config.imu, compressed, config.exposure_topic) as bag,
    ):
        samples = collections.deque(imu)
        for index, image in enumerate(in_order(moving.frame, len(moving), workers)):
            stamp = int(moving.stamps_ns[index])
            while samples and samples[0].stamp_ns <= stamp:
                bag.add_imu(samples.popleft())
            short = moving.is_short(index)
            bag.add_frame(stamp, image, moving.exposures.short_s if short else moving.exposures.long_s, short)
            progress(1)
        for sample in samples:
            bag.add_imu(sample)
    return {
        "T_world_board": moving.T_world_board,
        "exposure_long_s": moving.exposures.long_s,
        "exposure_short_s": moving.exposures.short_s,
        "gyro_bias": imu.gyro_bias.mean(axis=0),
        "accel_bias": imu.accel_bias.mean(axis=0),
    }


def write_rest(simulation: BoardSimulation, out: Path, progress: Callable[[int], object]) -> dict[str, Any]:
    """Write ``imu_rest``, a bag of nothing but the IMU at rest; return the truth about its noise."""
    config = simulation.config
    recording = record_rest(config.imu, simulation.start_ns, 3600.0 * config.board.rest_hours, simulation.seed)
    with BagWriter(out / "imu_rest", simulation.rig, config.imu, False, False, with_camera=False) as bag:
        bag.add_imu_recording(recording, progress)
    scale = config.imu.noise_scale
    return {key: scale * value for key, value in simulation.rig.document["imu0"].items() if key != "update_rate"}
