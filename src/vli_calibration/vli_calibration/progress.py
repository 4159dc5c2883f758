"""A progress bar on a terminal, and nothing in a pipe."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

from tqdm import tqdm

T = TypeVar("T")


def progress(items: Iterable[T], total: int | None, text: str) -> Iterator[T]:
    """Yield the items; on stderr, where that is a terminal, a bar says how far it is.

    Args:
        items: what takes its time, lazily.
        total: how many there are, None where nobody knows; a sized collection says so itself.
        text: what is being done, in a word or two.
    """
    yield from tqdm(items, desc=text, total=total, leave=False, file=sys.stderr, disable=not sys.stderr.isatty())
