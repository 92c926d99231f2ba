"""Shapes of the drift from the readings: a common motion is one, noise and a single position are none."""

from __future__ import annotations

import numpy as np

from interferometry.drift.shapes import common_shape

PLACE = np.linspace(0, 1, 16)
KNOWN = np.column_stack([np.ones(16), PLACE])
WARM_UP = 1.0 - np.exp(-np.arange(80) / 25.0)


def test_a_hot_zone_is_found_with_its_shape(rng: np.random.Generator) -> None:
    zone = np.minimum(PLACE, 0.55)
    residual = 15.0 * WARM_UP[:, None] * zone + rng.normal(0, 0.3, (80, 16))
    residual[10, 3] = np.nan
    shape = common_shape(residual, KNOWN)
    assert shape is not None
    expected = zone - KNOWN @ np.linalg.lstsq(KNOWN, zone, rcond=None)[0]
    # A motion of some 0.3 um rms in this shape over 80 cycles of 0.3 um: the shape is known to some per cent.
    assert abs(np.corrcoef(shape, expected)[0, 1]) > 0.98
    assert np.abs(shape).max() == 1.0
    assert np.abs(KNOWN.T @ shape).max() < 1e-9


def test_noise_has_no_shape(rng: np.random.Generator) -> None:
    # The level is 1 %: more than two of twenty by chance has a probability of 0.001.
    shapes = [common_shape(rng.normal(0, 0.3, (60, 16)), KNOWN) for _ in range(20)]
    assert sum(shape is not None for shape in shapes) <= 2


def test_a_single_position_is_no_shape(rng: np.random.Generator) -> None:
    residual = rng.normal(0, 0.3, (80, 16))
    residual[40:, 6] += 2.0
    assert common_shape(residual, KNOWN) is None


def test_memory_that_all_positions_have_is_no_shape(rng: np.random.Generator) -> None:
    residual = rng.normal(0, 0.3, (100, 16))
    for k in range(1, 100):
        residual[k] = 0.5 * residual[k - 1] + np.sqrt(0.75) * residual[k]
    assert common_shape(residual, KNOWN) is None


def test_too_few_cycles_or_targets_give_none(rng: np.random.Generator) -> None:
    assert common_shape(rng.normal(size=(14, 16)), KNOWN) is None
    assert common_shape(rng.normal(size=(80, 3)), KNOWN[:3]) is None
