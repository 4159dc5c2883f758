"""Coloured point map and window-to-map association; see docs/architecture.md."""

# Before anything here imports numpy: it limits BLAS to one thread.
import vli_common as vli_common
