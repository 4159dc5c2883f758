"""Libraries that only some users need: imported where they are used, with the command that installs them where they are not."""

from __future__ import annotations

import importlib
from typing import Any

from vli_common.errors import OutputError


def optional(module: str, extra: str, package: str = "vli_mapping") -> Any:
    """Return a module of an extra of a package, by default this one.

    Raises:
        OutputError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        raise OutputError(
            f"this needs '{library}', which cannot be imported ({error}); install it with: pip install '{package}[{extra}]'"
        ) from error
