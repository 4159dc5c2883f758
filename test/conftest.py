"""Fixtures that every test may use."""

from __future__ import annotations

import os
import random
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from vli_bringup.settings import Settings, to_yaml

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


@pytest.fixture(scope="module", autouse=True)
def own_domain() -> Iterator[None]:
    """Keep the nodes of a module apart from whatever else speaks ROS on this machine.

    Beyond 101, a domain's ports are among those that Linux gives to anybody.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(random.randint(1, 101)))
        yield


@pytest.fixture
def parameter_file(tmp_path: Path) -> Path:
    """Return a file with every parameter at its default, for nodes."""
    path = tmp_path / "vli.yaml"
    path.write_text(to_yaml(Settings()))
    return path
