"""Feature tracks, keyframes and IMU preintegration; see docs/architecture.md."""

# Before anything here imports numpy: it limits BLAS to one thread.
import vli_common as vli_common
