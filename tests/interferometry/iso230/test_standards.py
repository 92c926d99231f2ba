"""VDI/DGQ 3441 and JIS B 6330 against plain loops over the readings."""

from __future__ import annotations

import statistics

import numpy as np
import pytest

from interferometry.iso230 import evaluate_iso230, evaluate_other_standards
from tests.interferometry.iso230.made_tests import test_made


def by_loops(x: np.ndarray) -> dict[str, float]:
    """The definitions, one reading after the other."""
    middle, reversal, scatter, ranges, from_start = [], [], [], [], []
    for i in range(x.shape[2]):
        up, down = [float(v) for v in x[:, 0, i]], [float(v) for v in x[:, 1, i]]
        middle.append((statistics.fmean(up) + statistics.fmean(down)) / 2)
        reversal.append(abs(statistics.fmean(up) - statistics.fmean(down)))
        scatter.append(6 * (statistics.stdev(up) + statistics.stdev(down)) / 2)
        ranges += [max(up) - min(up), max(down) - min(down)]
        from_start += [abs(v - first) for v, first in zip(up, x[:, 0, 0], strict=True)]
        from_start += [abs(v - first) for v, first in zip(down, x[:, 1, -1], strict=True)]
    upper = [m + (u + p) / 2 for m, u, p in zip(middle, reversal, scatter, strict=True)]
    lower = [m - (u + p) / 2 for m, u, p in zip(middle, reversal, scatter, strict=True)]
    return {
        "position uncertainty P": max(upper) - min(lower),
        "position deviation Pa": max(middle) - min(middle),
        "largest position scatter Ps max": max(scatter),
        "mean position scatter Ps": statistics.fmean(scatter),
        "largest reversal U max": max(reversal),
        "mean reversal U": statistics.fmean(reversal),
        "positioning accuracy": max(from_start),
        "positioning repeatability (\u00b1)": max(ranges) / 2,
        "lost motion": max(reversal),
    }


def test_every_value_follows_its_definition() -> None:
    x = np.random.default_rng(9).normal(0, 3, (7, 2, 6))
    test = test_made(x)
    values = {value.name: value.value_um for value in evaluate_other_standards(test, cycles=range(1, 8))}
    assert values == pytest.approx(by_loops(x))
    axis = evaluate_iso230(test)
    assert values["position deviation Pa"] == pytest.approx(float(axis["M"]))
    assert values["lost motion"] == pytest.approx(float(axis["B"]))


def test_one_approach_has_no_such_evaluation() -> None:
    x = np.random.default_rng(9).normal(0, 3, (5, 2, 6))
    x[:, 1] = np.nan
    assert evaluate_other_standards(test_made(x), cycles=range(1, 6)) == []
