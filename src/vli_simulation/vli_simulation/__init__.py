"""A simulated hand-held laser-stripe scanner: ray-cast scenes, sensor, motion and IMU, written as a bag with its truth.

Nothing here is needed on a robot; only ``vli simulate`` and the tests use it.
"""

# Before anything here imports numpy: it limits BLAS to one thread.
import vli_common as vli_common
