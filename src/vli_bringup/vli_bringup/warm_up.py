"""Compile the kernels of every stage, so that neither a run nor a node waits for the compiler.

``python -m vli_bringup.warm_up`` does it once after installation; numba keeps the result beside the sources.
"""

from __future__ import annotations

import importlib
import sys
import time

PACKAGES = ("vli_common", "vli_driver", "vli_frontend", "vli_backend", "vli_mapping")
"""Packages with a module ``warm_up``."""


def warm_up() -> None:
    """Compile, or load from numba's cache, every kernel of every stage and of what they share."""
    for package in PACKAGES:
        importlib.import_module(f"{package}.warm_up").warm_up()


def main() -> int:
    """Warm up and say how long it took."""
    start_s = time.perf_counter()
    warm_up()
    print(f"kernels compiled in {time.perf_counter() - start_s:.0f} s", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
