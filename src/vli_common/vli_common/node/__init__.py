"""What every node is made of: parameters, calibration, sessions, a worker thread, diagnostics and a clean exit."""

from vli_common.node.base import VliNode
from vli_common.node.main import run_node
from vli_common.node.transport import set_transport_profile

__all__ = ["VliNode", "run_node", "set_transport_profile"]
