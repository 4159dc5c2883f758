"""Compile every kernel of this package, so that no frame waits for the compiler."""

from __future__ import annotations


def warm_up() -> None:
    """Run each compiled kernel once, with the types it meets at work; fast where the compiled code is in numba's cache."""
