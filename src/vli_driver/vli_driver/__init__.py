"""From sensor or bag to triangulated stripes: sources, demultiplexer, stripe detector, triangulation."""

# Before anything here imports numpy: it limits BLAS to one thread.
import vli_common as vli_common
