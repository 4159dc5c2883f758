"""``vli demo`` from the checkout: the bag that is shipped goes through the node graph within a minute."""

from __future__ import annotations

import re
import subprocess
import sys
import time

import pytest

from vli_bringup.demo import RECORDING

pytestmark = [pytest.mark.graph, pytest.mark.timeout(240)]


def test_the_demo_bag_is_small_and_has_a_truth():
    assert sum(item.stat().st_size for item in RECORDING.rglob("*") if item.is_file()) < 12e6
    assert all((RECORDING / name).exists() for name in ("bag", "calibration.yaml", "truth.tum"))


def test_the_demo_prints_figures_and_where_everything_lies(tmp_path):
    begin = time.monotonic()
    command = [sys.executable, "-m", "vli_bringup.cli", "demo"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=200)
    assert result.returncode == 0, result.stderr
    figures = dict(re.findall(r"^([\w ]+): +(.+)$", result.stdout, flags=re.MULTILINE))
    assert float(figures["error of the live poses"].split()[0]) < 0.5
    assert int(figures["map points"].replace(",", "")) > 1000
    for name in ("picture", "map", "poses"):
        assert (tmp_path / figures[name]).stat().st_size > 1000
    assert time.monotonic() - begin < 120
