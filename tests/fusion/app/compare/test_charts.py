from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.app.compare.charts import plot_profiles, plot_remaining, plot_scatters
from fusion.comparison.campaigns import PairComparison, compare_campaigns
from tests.fusion.compared_tests import readings_of, repaired, write_results


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> PairComparison:
    folder = tmp_path_factory.mktemp("compared")
    before = write_results(folder / "before", readings_of(31))
    (found,) = compare_campaigns([before, write_results(folder / "after", repaired(readings_of(33), -1.2))])
    return found


def test_profiles_are_drawn_about_their_means(pair: PairComparison) -> None:
    chart = plot_profiles([pair.before, pair.after], ["A", "B"])
    assert chart is not None
    assert [abs(float(np.mean(chart.columns[f"deviation, {name} / µm"]))) < 1e-9 for name in "AB"] == [True, True]
    assert chart.seen.startswith("Profiles about their means: A ")


def test_what_remains_names_the_position_that_changed(pair: PairComparison) -> None:
    chart = plot_remaining(pair)
    assert chart is not None and chart.seen.endswith("changed: 80 mm.")
    assert plot_remaining(replace(pair, profile=None)) is None


def test_scatter_starts_at_zero_and_campaigns_without_readings_are_left_out(pair: PairComparison) -> None:
    bare = replace(pair.after, drift=None)
    chart = plot_scatters([pair.before, bare], ["A", "B"])
    assert chart is not None and "B" not in chart.seen and chart.figure.y_range.start == 0.0
    assert plot_scatters([bare], ["B"]) is None and plot_profiles([bare], ["B"]) is None
