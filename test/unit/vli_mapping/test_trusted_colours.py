"""What the nearest trusted points say of a place around which nothing is trusted."""

from __future__ import annotations

import numpy as np

from vli_mapping.trusted_colours import from_afar

RED, BLUE = np.array([200.0, 20.0, 20.0]), np.array([20.0, 20.0, 200.0])


def test_the_nearer_side_counts_most_and_what_is_trusted_asks_for_nothing() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0.0, 0.002, (100, 3)), rng.uniform(0.008, 0.010, (100, 3)), [[0.003] * 3, [0.007] * 3]])
    colours = np.concatenate([np.tile(RED, (100, 1)), np.tile(BLUE, (100, 1)), np.zeros((2, 3))]).astype(np.float32)
    trust = np.concatenate([np.full(200, 3.0), np.full(2, 0.01)]).astype(np.float32)
    far = from_afar(points, colours, trust)
    assert np.isnan(far[:200]).all()
    np.testing.assert_allclose(far[200], RED, atol=20.0)
    np.testing.assert_allclose(far[201], BLUE, atol=20.0)


def test_nothing_is_said_of_what_is_too_far_off_or_was_not_seen() -> None:
    points = np.concatenate([np.random.default_rng(1).uniform(0.0, 0.002, (100, 3)), [[0.05, 0.0, 0.0], [0.003, 0.0, 0.0]]])
    colours = np.tile(RED, (102, 1)).astype(np.float32)
    colours[101] = np.nan
    trust = np.concatenate([np.full(100, 3.0), np.full(2, 0.01)]).astype(np.float32)
    assert np.isnan(from_afar(points, colours, trust)).all()


def test_where_nothing_is_trusted_there_is_nobody_to_ask() -> None:
    points, colours = np.random.default_rng(2).uniform(0.0, 0.002, (100, 3)), np.tile(RED, (100, 1)).astype(np.float32)
    assert np.isnan(from_afar(points, colours, np.full(100, 0.1, np.float32))).all()
