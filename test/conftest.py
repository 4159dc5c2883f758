"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import pytest

# The first example of a test may compile or load a kernel.
hypothesis.settings.register_profile("vli", deadline=None)
hypothesis.settings.load_profile("vli")

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def repository() -> Path:
    """Return the root of the workspace."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the directory of recordings: ``$VLI_SHARED/data``, by default ``../shared/data``; skip where it is absent."""
    path = Path(os.environ.get("VLI_SHARED", REPOSITORY.parent / "shared")) / "data"
    if not path.is_dir():
        pytest.skip(f"needs the recordings in '{path}'; set VLI_SHARED to the directory that holds 'data'")
    return path
