"""Types, geometry, calibration and ROS plumbing shared by every package of the scanner.

Importing this package limits BLAS and OpenMP to one thread each, unless the environment says otherwise. The matrices here
are small (at most some hundred rows): a second thread only costs latency, and on a busy machine it costs a factor of ten.
That works only when numpy has not been imported yet, which is why it stands here and nowhere else.
"""

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

__version__ = "0.1.0"
