"""What a node of the graph says of its stage, and does with it."""

from __future__ import annotations

from vli_common.calibration import Calibration
from vli_common.messages import Session
from vli_common.status import Health
from vli_common.types import Counters


class StageHooks:
    """Methods that :class:`vli_common.node.VliNode` calls, in its worker thread except for :meth:`check`; all are optional."""

    def check(self) -> None:
        """Raise where the node cannot be configured; runs in the main thread, before anything is made.

        Raises:
            VliError: what is missing or wrong.
        """

    def create_stage(self, calibration: Calibration | None) -> None:
        """Make the stage objects (again, where parameters have changed) and warm their kernels."""

    def drop_stage(self) -> None:
        """Let go of the stage objects: the node is cleaned up."""

    def on_session(self, session: Session) -> None:
        """Drop all state of other sessions; ``self.session`` is the new one."""

    def on_pause(self) -> None:
        """Bring to an end what is under way."""

    def on_resume(self) -> None:
        """Begin, or go on after a pause."""

    def on_finish(self) -> None:
        """Process what is still held back: the input has ended."""

    def on_restart(self, node: str) -> None:
        """Another node of the graph has been started anew: what it knew is gone."""

    def stage_counters(self) -> Counters:
        """Return the counters of the stage."""
        return Counters()

    def stage_status(self) -> tuple[Health, str, dict[str, str]]:
        """Return the stage's health, a hint in words, and further values."""
        return Health.OK, "", {}
