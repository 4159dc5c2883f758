"""Calibration of a real scanner: camera, laser plane, IMU, and how far each can be trusted.

Nothing here is needed while scanning; only ``vli calibrate`` and the tests use it.
"""

# Before anything here imports numpy: it limits BLAS to one thread.
import vli_common as vli_common
