"""How large a number in a message may be: beyond, no sensor and no scan has sent it, and its square may not be finite."""

from __future__ import annotations

from vli_common.arrays import AnyArray
from vli_common.errors import MessageError

LARGEST = 1e6
"""Of metres, pixels, radians, and all that is made of them per second."""
LARGEST_VARIANCE = LARGEST**2


def checked(values: AnyArray, what: str, largest: float = LARGEST) -> AnyArray:
    """Return numbers of any shape that are finite and at most ``largest``.

    Raises:
        MessageError: naming the first that is not.
    """
    # NaN is not at most anything.
    holds = abs(values) <= largest
    if not holds.all():
        raise MessageError(f"{what} has '{values[~holds].flat[0]}', expected finite values up to {largest:g}")
    return values
