import json

import numpy as np
import pytest

from fusion.analysis.comparison import compare_campaigns
from fusion.report.charts.comparison import control_limits, plot_trend
from fusion.report.comparison import (
    campaign_names,
    changes_table,
    comparison_json,
    conclude_comparison,
    render_comparison,
    side_by_side,
)
from tests.fusion.compared_tests import readings_of, repaired, write_results


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compared")
    before = write_results(folder / "before", readings_of(31), title="before the repair")
    after = write_results(folder / "after", repaired(readings_of(33), -1.2), title="after the repair")
    return compare_campaigns([before, after, write_results(folder / "y", readings_of(32), axis="Y")])


def test_what_changed_is_said_with_its_uncertainty(pairs):
    first, assumption = conclude_comparison(pairs[0])
    assert first.startswith("Changed by more than the uncertainties: deviation at 80 mm by −1.")
    assert "±" in first
    assert "5 % over all" in assumption
    assert conclude_comparison(pairs[1]) == ["Nothing can be compared."]


def test_the_table_marks_what_changed(pairs):
    shown = changes_table(pairs[0])
    marked = {row.cells[0]: row.cells[-1] for row in shown.rows if row.marked}
    assert marked["deviation at 80 mm"] == "changed"
    assert set(marked.values()) <= {"changed", "differs; the thermal state of a test alone can cause that"}
    assert all(len(row.cells) == len(shown.titles) for row in shown.rows)


def test_all_campaigns_stand_side_by_side(pairs):
    assert campaign_names(pairs) == ["A (before the repair)", "B (after the repair)", "C (X axis)"]
    shown = {row.cells[0]: row.cells[1:] for row in side_by_side(pairs).rows}
    assert shown["A by ISO 230-2"] == ["1.00 ± 0.20 µm"] * 3
    assert shown["positions that stand out"] == ["none"] * 3


def test_programs_get_the_same_as_json(pairs, tmp_path):
    told = json.loads(json.dumps(comparison_json(pairs), allow_nan=False))
    changes = {(one["quantity"], one["position_mm"]): one for one in told["compared"][0]["changes"]}
    assert changes["position", 80.0]["significant"] and changes["position", 80.0]["machine"]
    assert told["compared"][1]["not_compared"] == ["Everything: the axes differ (X and Y): nothing is compared."]


def test_the_document_says_what_changed_before_it_shows_it(pairs):
    page = render_comparison(pairs)
    assert (
        page.index("Changed by more than the uncertainties") < page.index("Signature") < page.index("figure-profiles")
    )


def test_control_limits_are_those_of_the_handbook():
    """NIST/SEMATECH e-Handbook of Statistical Methods, 6.3.2.2: flow rates of ten batches."""
    flow = np.array([49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1])
    assert control_limits(flow) == pytest.approx((45.8159, 50.81, 55.8041), abs=0.001)
    assert control_limits(flow[:7]) is None


def test_a_trend_says_what_lies_outside_its_limits():
    dates = np.datetime64("2026-01-01", "D") + 30 * np.arange(12)
    values = np.array([5.0, 5.2, 4.9, 5.1, 5.0, 5.2, 4.8, 5.1, 5.0, 4.9, 5.1, 9.0])
    seen = plot_trend(dates, values, np.full(12, 0.1), "A").seen
    assert "A of 12 tests: 4.80 to 9.00 µm" in seen and "1 of 12 outside" in seen
    assert "control limits need 8 tests" in plot_trend(dates[:3], values[:3], np.zeros(3), "A").seen
    assert plot_trend(dates[:2], values[:2], np.zeros(2), "A") is None
