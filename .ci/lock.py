"""Write requirements.lock and requirements-numpy1.lock: every package that pip would install, pinned.

Run it with the oldest supported Python (`make lock`), whose versions the newer ones can install too. The second file is for
the oldest supported numpy, the one that Ubuntu 24.04 ships; top-level pins are lifted there, but for numpy's.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OLDEST_NUMPY = "numpy==1.26.4"
# Stubs follow the newest numpy; types are checked in the first environment only.
NOT_WITH_OLDEST_NUMPY = ("mypy", "ruff", "pre-commit", "scipy-stubs", "types-", "numpy")


def requirements() -> list[str]:
    """Return the pinned top-level requirements, tools included."""
    lines = [
        line.strip() for name in ("requirements.txt", "requirements-dev.txt") for line in (ROOT / name).read_text().splitlines()
    ]
    return [line for line in lines if line and not line.startswith("#")]


def resolve(wanted: list[str]) -> list[str]:
    """Return what pip would install for ``wanted`` into an empty environment, pinned and sorted."""
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "-qq", "--report", "-", *wanted]
    report = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    pins = {re.sub(r"[-_.]+", "-", item["metadata"]["name"]).lower(): item["metadata"]["version"] for item in report["install"]}
    return [f"{name}=={version}" for name, version in sorted(pins.items())]


def write(name: str, pins: list[str]) -> None:
    """Write one lock file with its heading."""
    (ROOT / name).write_text("\n".join(["# Written by `make lock`; do not edit.", *pins]) + "\n")


def main() -> None:
    """Resolve both environments and write their files."""
    wanted = requirements()
    write("requirements.lock", resolve(wanted))
    lifted = [re.split("==", item)[0] for item in wanted if not item.startswith(NOT_WITH_OLDEST_NUMPY)]
    # setuptools has no upper bound of its own, yet colcon needs an older one; OpenCV 5 is not ours.
    write("requirements-numpy1.lock", resolve([*lifted, OLDEST_NUMPY, "opencv-python-headless<5"]))


if __name__ == "__main__":
    main()
