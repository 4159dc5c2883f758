"""The managed life of a node, as ``ros2 lifecycle`` and lifecycle managers know it.

unconfigured —configure→ inactive —activate→ active —deactivate→ inactive —cleanup→ unconfigured; shutdown from anywhere. A node
takes itself to *active* when it starts, so that ``ros2 run`` is all it takes; with ``autostart`` false it waits for a manager.
"""

from __future__ import annotations

from collections.abc import Callable

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from vli_common.errors import VliError

_OUTCOME = TransitionCallbackReturn


class ManagedNode(LifecycleNode):
    """A lifecycle node whose transitions are four methods that raise where they cannot be made.

    Args:
        name: of the node.
        namespace: that it lives in.
    """

    def __init__(self, name: str, namespace: str) -> None:
        super().__init__(name, namespace=namespace)
        self.is_active = False
        """True from activation to deactivation."""
        self.is_shut_down = False
        """True once a manager has shut the node down: its process ends."""
        self._refusal: VliError | None = None
        self._tells_refusals = True

    # Transitions of a subclass

    def configure(self) -> None:
        """Read parameters and files, make the stage.

        Raises:
            VliError: something is missing or wrong; the node stays unconfigured.
        """

    def activate(self) -> None:
        """Begin to process."""

    def deactivate(self) -> None:
        """Bring to an end what is under way, and process nothing more."""

    def clean_up(self) -> None:
        """Drop stage and calibration; the next configuration makes them anew."""

    def bring_up(self) -> None:
        """Configure and activate.

        Raises:
            VliError: as :meth:`configure` does.
        """
        # Who starts the node gets the refusal as an exception; a manager would find it in the log only.
        self._tells_refusals = False
        outcome = self.trigger_configure()
        self._tells_refusals = True
        if outcome is not _OUTCOME.SUCCESS:
            raise self._refusal or VliError(f"'{self.get_name()}' cannot be configured")
        self.trigger_activate()

    def destroy_node(self) -> None:
        """Take the node out of the graph now: rclpy leaves its state machine, and the node with it, to a garbage collection."""
        self._state_machine.destroy_when_not_in_use()
        super().destroy_node()

    # What rclpy calls

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """See :meth:`configure`."""
        return self._change(self.configure, self.is_active)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """See :meth:`activate`."""
        return self._change(self.activate, True)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """See :meth:`deactivate`."""
        return self._change(self.deactivate, False)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """See :meth:`clean_up`."""
        return self._change(self.clean_up, False)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the process end, as a signal would."""
        self.is_shut_down = True
        return _OUTCOME.SUCCESS

    def _change(self, action: Callable[[], None], active: bool) -> TransitionCallbackReturn:
        was_active, self.is_active = self.is_active, active
        try:
            action()
        except VliError as error:
            self.is_active, self._refusal = was_active, error
            if self._tells_refusals:
                self.get_logger().error(str(error))
            return _OUTCOME.FAILURE
        return _OUTCOME.SUCCESS
