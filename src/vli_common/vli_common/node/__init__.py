"""What every node is made of: parameters, calibration, sessions, a worker thread, diagnostics and a clean exit.

Importing this package limits OpenCV to one thread, unless the environment says otherwise: five processes share the cores.
"""

import os

from vli_common.node.base import VliNode
from vli_common.node.main import run_node
from vli_common.node.transport import set_transport_profile

os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

__all__ = ["VliNode", "run_node", "set_transport_profile"]
