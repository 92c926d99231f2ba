"""The chart of the standard shows means, 2 s, and the spans of A, E and B."""

from __future__ import annotations

import numpy as np
import pytest
from bokeh.models import Label

from fusion.report.charts.iso230 import plot_single_runs, plot_test
from interferometry.iso230 import evaluate_iso230
from tests.interferometry.iso230.made_tests import by_hand, test_made


def test_means_and_spans_are_those_of_the_readings() -> None:
    x = np.random.default_rng(5).normal(0, 1, (5, 2, 6)) + 3.0 * np.arange(6)
    test = test_made(x)
    chart = plot_test(evaluate_iso230(test), test["position"])
    np.testing.assert_allclose(chart.columns["mean, positive approach / \u00b5m"], x[:, 0].mean(axis=0))
    np.testing.assert_allclose(chart.columns["s, negative approach / \u00b5m"], x[:, 1].std(axis=0, ddof=1))
    true = by_hand(x)
    texts = {label.text for label in chart.figure.select({"type": Label})}
    assert texts == {f"A {true['A']:.2f}", f"E {true['E']:.2f}", f"B {true['B']:.2f}"}
    assert chart.seen.startswith("Mean deviation over 0.00 to 50.00 mm of the axis with \u00b12 s: positive approach ")


def test_one_approach_has_a_chart_without_b() -> None:
    x = np.random.default_rng(5).normal(0, 1, (5, 2, 6))
    x[:, 1] = np.nan
    test = test_made(x)
    chart = plot_test(evaluate_iso230(test), test["position"])
    assert "mean, negative approach / \u00b5m" not in chart.columns
    assert not any(label.text.startswith("B") for label in chart.figure.select({"type": Label}))


def test_a_single_run_shows_its_readings() -> None:
    x = np.arange(12.0).reshape(1, 2, 6)
    chart = plot_single_runs(test_made(x))
    assert chart.columns["cycle 1, negative approach / \u00b5m"] == pytest.approx(np.arange(6.0, 12.0))


def test_the_labels_of_both_spans_stand_apart() -> None:
    test = test_made(np.random.default_rng(5).normal(0, 0.1, (5, 2, 6)) + 3.0 * np.arange(6))
    labels = {
        label.text[0]: label
        for label in plot_test(evaluate_iso230(test), test["position"]).figure.select({"type": Label})
    }
    # Text of 12 px is a fifteenth of the chart's height.
    assert labels["E"].y - labels["A"].y > 15.0 / 15
    assert labels["A"].x < labels["E"].x
