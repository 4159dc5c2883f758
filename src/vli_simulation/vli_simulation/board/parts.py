"""The parts of a set of calibration data, and the files that say the truth about them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import yaml

from vli_common.calibration import to_yaml
from vli_simulation.board.recordings import MovingBoard, write_moving_board, write_rest
from vli_simulation.board.simulate import BoardSimulation
from vli_simulation.board.stills import POSES_FILE, camera_stills, laser_stills, write_arm_poses, write_stills
from vli_simulation.config import RECORD, to_document

Progress = Callable[[int], object]


class Part(Protocol):
    """A part that is planned (errors show here, before anything is written) and then written."""

    def __len__(self) -> int:
        """Return in how many steps the progress is counted."""

    def write(self, out: Path, workers: int | None, progress: Progress) -> dict[str, Any]:
        """Write the part into a directory; return the truth about it."""


class CameraPart:
    """``camera/``: images for ``vli calibrate camera``."""

    def __init__(self, simulation: BoardSimulation) -> None:
        self._simulation, self._stills = simulation, camera_stills(simulation)

    def __len__(self) -> int:
        return len(self._stills)

    def write(self, out: Path, workers: int | None, progress: Progress) -> dict[str, Any]:
        """See :meth:`Part.write`."""
        return {"board_poses": write_stills(self._simulation, self._stills, out / "camera", workers, progress)}


class LaserPart:
    """``laser/``: images for ``vli calibrate laser`` and ``check``, with the arm's poses where an arm holds the sensor."""

    def __init__(self, simulation: BoardSimulation) -> None:
        self._simulation, self._stills = simulation, laser_stills(simulation)

    def __len__(self) -> int:
        return len(self._stills)

    def write(self, out: Path, workers: int | None, progress: Progress) -> dict[str, Any]:
        """See :meth:`Part.write`."""
        truth: dict[str, Any] = {"board_poses": write_stills(self._simulation, self._stills, out / "laser", workers, progress)}
        if self._simulation.config.board.arm:
            truth["arm"] = write_arm_poses(self._simulation, self._stills, out / "laser" / POSES_FILE)
        return truth


class BagPart:
    """``bag`` and ``truth.tum``: the sensor moving before the board, for ``vli calibrate imu-camera``."""

    def __init__(self, simulation: BoardSimulation) -> None:
        self._simulation, self._moving = simulation, MovingBoard(simulation)

    def __len__(self) -> int:
        return len(self._moving)

    def write(self, out: Path, workers: int | None, progress: Progress) -> dict[str, Any]:
        """See :meth:`Part.write`."""
        return {"bag": write_moving_board(self._simulation, self._moving, out, workers, progress)}


class RestPart:
    """``imu_rest``: a bag of the IMU lying still, for ``vli calibrate imu``."""

    def __init__(self, simulation: BoardSimulation) -> None:
        self._simulation = simulation

    def __len__(self) -> int:
        config = self._simulation.config
        return int(3600.0 * config.board.rest_hours * config.imu.rate_hz)

    def write(self, out: Path, workers: int | None, progress: Progress) -> dict[str, Any]:
        """See :meth:`Part.write`."""
        return {"imu_rest": write_rest(self._simulation, out, progress)}


PARTS: dict[str, Callable[[BoardSimulation], Part]] = {
    "camera": CameraPart,
    "laser": LaserPart,
    "bag": BagPart,
    "rest": RestPart,
}
"""Name → part."""


def write_truth(simulation: BoardSimulation, truth: list[dict[str, Any]], out: Path) -> None:
    """Write what is true, what the drawing says, and what was asked for.

    ``calibration.yaml`` is the instrument as it is; ``nominal.yaml`` is the drawing: a first guess, with the IMU's data sheet.
    ``truth.yaml`` has the keys of the calibration and, beside them, target, poses of the board and all else about the parts.
    """
    exact = simulation.rig.document
    (out / "calibration.yaml").write_text(to_yaml(exact))
    (out / "nominal.yaml").write_text(to_yaml(simulation.drawing.document))
    document: dict[str, Any] = {**exact, "target": simulation.target.spec, "seed": simulation.seed, "board_poses": {}}
    for part in truth:
        document["board_poses"] |= part.pop("board_poses", {})
        document |= part
    (out / "truth.yaml").write_text(to_yaml(document))
    settings = {"seed": simulation.seed, "target": simulation.target.spec, **to_document(simulation.config)}
    (out / RECORD).write_text(yaml.safe_dump(settings, sort_keys=False))
