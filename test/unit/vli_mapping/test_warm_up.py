"""What is compiled, is compiled before the first frame."""

from __future__ import annotations

import subprocess
import sys

GROWING = """
import numpy as np
from numba.core.dispatcher import Dispatcher

from vli_mapping.config import MapConfig
from vli_mapping.contradiction import contradict
from vli_mapping.point_map import PointMap, Stripe
from vli_mapping.warm_up import warm_up

warm_up()


def refuse(self, *args, **kwargs):
    raise SystemExit(f"'{self.py_func.__name__}' is compiled while a scan is under way")


Dispatcher._compile_for_args = refuse
point_map, count = PointMap(MapConfig()), 2000
side = np.linspace(-0.2, 0.2, count)
for number in range(60):
    points = np.stack([side, np.full(count, 3e-4 * number), np.full(count, 0.03)], axis=1)
    normals, solid = np.tile(np.float32([0, 0, -1]), (count, 1)), np.ones(count, np.bool_)
    colours, sigma = np.zeros((count, 3), np.float32), np.full(count, 3e-5)
    stripe = Stripe(0, number, np.eye(4), points, normals, np.ones(count, np.float32), colours, sigma, solid)
    point_map.insert(contradict(point_map, stripe)[0])
# What is in front of them.
before = len(point_map)
for number in range(60, 70):
    near = Stripe(0, number, np.eye(4), 1.1 * points, normals, np.ones(count, np.float32), colours, sigma, solid)
    contradict(point_map, near)
if len(point_map) == before:
    raise SystemExit("nothing was contradicted")
print(before)
"""


def test_a_map_that_outgrows_its_first_size_waits_for_no_compiler():
    done = subprocess.run([sys.executable, "-c", GROWING], capture_output=True, text=True, timeout=300)
    assert done.stderr == ""
    assert int(done.stdout) > 100_000
