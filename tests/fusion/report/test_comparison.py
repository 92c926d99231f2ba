import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.attribution.places import ChannelAgreement, PlaceComparison, SourceAgreement
from fusion.analysis.comparison import Achieved, TableFault
from fusion.pipeline.compare import compare_campaigns
from fusion.report.charts.comparison import control_limits, draw_trend, follow, follow_trends, plot_profiles
from fusion.report.comparison import (
    achieved_table,
    campaign_names,
    change_name,
    changes_of_all,
    changes_table,
    comparison_json,
    conclude_comparison,
    conclude_table,
    describe_pair,
    describe_places,
    render_comparison,
    short_names,
    side_by_side,
    trend_caption,
)
from fusion.report.letterhead import Letterhead
from fusion.results.parts import Quantity
from tests.fusion.compared_tests import readings_of, repaired, write_results
from tests.fusion.results_sample import PARTS


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compared")
    before = write_results(folder / "before", readings_of(31), title="before the repair")
    after = write_results(folder / "after", repaired(readings_of(33), -1.2), title="after the repair")
    return compare_campaigns([before, after, write_results(folder / "y", readings_of(32), axis="Y")])


def test_what_changed_is_said_with_its_uncertainty(pairs):
    first = conclude_comparison(pairs[0])
    assert first.startswith("Changed by more than the uncertainties: deviation at 80 mm by −1.")
    assert "±" in first
    assert conclude_comparison(pairs[1]) == "Nothing can be compared."


@pytest.mark.parametrize(
    ("change", "u", "verdict"),
    [
        (9.3, 3.1, "not significant among 58 comparisons"),
        (5.0, 3.1, "within the uncertainties"),
        (5.0, None, "no uncertainty: not judged"),
    ],
)
def test_a_change_beyond_its_stated_uncertainty_is_not_said_to_lie_within_it(pairs, change, u, verdict):
    shown = replace(
        pairs[0].changes[0], quantity="A", group="ISO 230-2", position_mm=None, change=Quantity(value=change, u=u),
        p_value=0.15, family=58,
    )  # fmt: skip
    (row,) = changes_table([one := replace(pairs[0], changes=(shown,))], one).rows
    assert row.cells[-1] == verdict


def test_predicted_and_achieved_stand_beside_each_other(pairs):
    def one(symbol, achieved):
        difference = Quantity(value=achieved - 1.0, u=0.5)
        stated = Quantity(value=2.0, u=0.2)
        known = (Quantity(value=9.0, u=1.0), stated, Quantity(value=1.0, u=0.1), Quantity(value=achieved, u=0.4))
        return Achieved(symbol, *known, difference)

    pair = replace(pairs[0], achieved=(one("A", 3.0), one("E", 1.5)))
    a, e = achieved_table(pair).rows
    assert a.cells[1:] == [
        "9.0 ± 2.0",
        "2.00 ± 0.40",
        "1.00 ± 0.20",
        "3.00 ± 0.80",
        "2.0 ± 1.0",
        "beyond the uncertainty",
    ]
    assert a.marked and not e.marked and not pair.is_kept
    assert conclude_table(pair)[0].startswith("With the table A differs from the prediction")
    kept = replace(pair, achieved=(one("E", 1.5),))
    assert conclude_table(kept) == ["With the table E is as predicted within the uncertainty."] and kept.is_kept
    # As large an uncertainty as the table's effect tells nothing.
    wide = replace(kept.achieved[0], difference=Quantity(value=0.5, u=5.0))
    assert conclude_table(replace(pair, achieved=(wide,)))[0].startswith("Of E the uncertainty is so large")
    assert achieved_table(replace(pair, achieved=(wide,))).rows[0].cells[-1].startswith("not told")
    acted = TableFault(("not active", "half the gain"), 0.2, 0.15, told=True)
    faulty = replace(kept, table=acted)
    assert conclude_table(faulty)[0].startswith("The table did not act as it states: not active or half the gain (")
    assert "cannot be told while the table" in conclude_comparison(faulty) and not faulty.is_kept
    assert conclude_table(replace(kept, table=replace(acted, names=(), told=False)))[0].endswith("changes as well.")
    assert comparison_json([faulty])["compared"][0]["table"]["names"] == ["not active", "half the gain"]
    assert conclude_table(pairs[0]) == []
    page = render_comparison([pair])
    assert page.index("With the table A differs") < page.index("figure-profiles") < page.index("Predicted and achieved")
    told = comparison_json([pair])["compared"][0]["achieved"]
    assert [(row["quantity"], row["as_predicted"]) for row in told] == [("A", False), ("E", True)]


def test_steps_and_blocks_are_named_by_where_they_are(pairs):
    def named(quantity, until=None):
        return change_name(replace(pairs[0].changes[0], quantity=quantity, position_mm=100.0, until_mm=until))

    assert named("step") == "deviation from 100 mm on"
    assert named("block", 200.0) == "deviation from 100 to 200 mm"
    assert named("profile") == "profile beyond offset, slope and bow, most at 100 mm,"


def test_the_table_marks_what_changed(pairs):
    shown = changes_table(pairs, pairs[0])
    marked = {row.cells[0]: row.cells[-1] for row in shown.rows if row.marked}
    assert marked["deviation at 80 mm"] == "changed"
    assert set(marked.values()) <= {"changed", "differs; the thermal state of a test alone can cause that"}
    assert all(len(row.cells) == len(shown.titles) for row in shown.rows)


def test_all_campaigns_stand_side_by_side(pairs):
    assert campaign_names(pairs) == ["A (before the repair)", "B (after the repair)", "C (X axis)"]
    assert campaign_names(pairs[:1]) == ["as found (before the repair)", "as left (after the repair)"]
    shown = {row.cells[0]: row.cells[1:] for row in side_by_side(pairs).rows}
    assert shown["A by ISO 230-2"] == ["1.00 ± 0.20 µm"] * 3
    assert shown["positions that stand out"] == ["none"] * 3


def test_programs_get_the_same_as_json(pairs, tmp_path):
    told = json.loads(json.dumps(comparison_json(pairs), allow_nan=False))
    changes = {(one["quantity"], one["position_mm"]): one for one in told["compared"][0]["changes"]}
    assert changes["position", 80.0]["significant"] and changes["position", 80.0]["machine"]
    assert told["compared"][1]["not_compared"] == ["Everything: the axes differ (X and Y): nothing is compared."]


def test_two_tests_are_a_sheet_to_sign_and_what_changed(pairs):
    page = render_comparison(pairs[:1])
    places = [
        page.index(words)
        for words in ("Changed by more than the uncertainties", "figure-profiles", "Date, signature", "What changed", "Annex")
    ]  # fmt: skip
    assert places == sorted(places)


def test_the_sheet_states_whose_axis_it_was_what_was_done_and_the_decisions(tmp_path):
    def part(day, a_um, decision, **more):
        stated = {"date": day, "machine": "Mill 7", "operator": "R. Meyer", **more}
        judged = {"quantity": "A", "limit_um": 2.0, "value_um": a_um, "expanded_u_um": 0.2, "decision": decision}
        whole = {
            **copy.deepcopy(PARTS["iso230"]), "conditions": [
                {"key": key, "name": key.capitalize(), "text": text} for key, text in stated.items()
            ],
            "tolerances": [judged],
        }  # fmt: skip
        whole["A_um"] = {"value": a_um, "u": 0.1}
        return whole

    readings = readings_of(31)
    found = write_results(tmp_path / "found", readings, iso230=part("1 March", 3.0, "fail"))
    left = write_results(tmp_path / "left", readings, iso230=part("2 March", 1.0, "pass", remarks="gib adjusted"))
    sheet = describe_pair(compare_campaigns([found, left])[0])
    identity = dict(sheet.stated.identity)
    assert identity["Machine"] == "Mill 7"
    assert identity["Date, as found"] == "1 March" and identity["Date, as left"] == "2 March"
    assert identity["Done between the tests"] == "gib adjusted"
    (back,) = compare_campaigns(
        [left, write_results(tmp_path / "again", readings, iso230=part("3 March", 1.0, "pass", remarks="gib adjusted"))]
    )
    assert dict(describe_pair(back).stated.identity)["Done between the tests"] == "not stated"
    german = describe_pair(back, Letterhead(language="de"))
    assert german.title == "Eingangszustand und Ausgangszustand" and german.values.titles[3] == "Änderung / µm"
    assert dict(german.stated.identity)["Zwischen den Prüfungen ausgeführt"] == "nicht angegeben"
    assert dict(german.stated.identity)["Date, Ausgangszustand"] == "3 March"
    assert sheet.stated.signatures[0] == ("Measured by", "R. Meyer")
    row = sheet.values.rows[0]
    assert row.marked
    assert row.cells[1:] == ["3.00 ± 0.20", "1.00 ± 0.20", "−2.00 ± 0.28", "differs", "2", "fail", "pass"]
    assert len(set(sheet.files.values())) == 2


def test_more_tests_are_a_trend_with_short_names_and_room_for_them(pairs):
    page = render_comparison(pairs)
    assert "Trend of 3 tests" in page and "As found, as left" not in page
    assert page.index("Changed by more than the uncertainties".lower()[1:]) < page.index("figure-profiles")
    tests = [pairs[0].before] * 6
    names = [f"{letter}, 2026-03-09" for letter in "ABCDEF"]
    few, many = plot_profiles(tests[:2], names[:2]).figure, plot_profiles(tests, names).figure
    assert many.legend.ncols == 2
    assert many.height - few.height == pytest.approx(2 * 28)
    assert short_names(pairs) == ["A", "B", "C"]
    assert {len(row.cells) for row in changes_of_all(pairs).rows} == {3}


def test_control_limits_are_those_of_the_handbook():
    """NIST/SEMATECH e-Handbook of Statistical Methods, 6.3.2.2: flow rates of ten batches."""
    flow = np.array([49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1])
    assert control_limits(flow) == pytest.approx((45.8159, 50.81, 55.8041), abs=0.001)
    assert control_limits(flow[:6]) is None


DATES = np.datetime64("2026-01-01", "D") + 30 * np.arange(12)


def test_the_last_test_is_held_against_limits_of_those_before_it():
    """Among those that give the limits, its own leap would widen them so that it lay within."""
    values = np.array([5.0, 5.2, 4.9, 5.1, 5.0, 5.2, 4.8, 5.1, 5.0, 4.9, 5.1, 5.7])
    trend = follow(DATES, values, np.full(12, 0.1), "A")
    assert control_limits(values).high > 5.7 > trend.limits.high
    assert trend.outside.tolist() == [False] * 11 + [True]
    assert "A of 12 tests: 4.80 to 5.70 µm" in draw_trend(trend).seen and "1 of 12 outside" in draw_trend(trend).seen
    assert trend_caption(trend).startswith("A of the last test, 5.70 µm, lies outside the control limits 4.47 to 5.")
    assert trend_caption(follow(DATES[:7], values[:7], np.zeros(7), "A")) == ""


def test_fewer_tests_have_no_limits_and_no_word_of_them():
    values = np.arange(3.0)
    assert "control limits need 8 tests" in draw_trend(follow(DATES[:3], values, np.zeros(3), "A")).seen
    assert follow(DATES[:2], values[:2], np.zeros(2), "A") is None


def test_a_tolerance_lies_within_the_chart():
    trend = follow(DATES[:3], np.array([5.0, 6.0, 5.0]), np.zeros(3), "A", tolerance=20.0)
    chart = draw_trend(trend)
    assert chart.figure.y_range.start < 5.0 and chart.figure.y_range.end > 20.0
    assert "tolerance 20 µm" in chart.seen


def test_bars_of_a_trend_leave_out_what_all_tests_have_in_common(tmp_path):
    """u² = 5² of which 4² is the coefficient's in every test: 3 is left."""

    def part():
        row = {"contributor": "expansion_coefficient", "u": 2.0, "unit": "ppm/K", "origin": "assumed"}
        shares = dict.fromkeys(("R_um", "E_um", "M_um", "B_um", "mean_reversal_um"), 0.0)
        whole = copy.deepcopy(PARTS["iso230"])
        whole["conditions"] = [{"key": "expansion_coefficient", "name": "Reworded", "text": "11.7 ppm/K"}]
        whole |= {"A_um": {"value": 9.0, "u": 5.0}, "contributions": [{**row, "A_um": 4.0, **shares}]}
        return whole

    folders = []
    for k in range(3):
        time = {"first": f"2026-0{k + 1}-01T00:00:00Z", "last": f"2026-0{k + 1}-01T02:00:00Z", "zone": "UTC"}
        folders.append(write_results(tmp_path / str(k), readings_of(31), iso230=part(), time=time))
    trend = follow_trends(compare_campaigns(folders))[0]
    assert trend.name == "A"
    assert trend.half == pytest.approx([6.0] * 3)


AGREED = SourceAgreement(
    "joint",
    330.0,
    90.0,
    (0, 1),
    (0.004, 0.004),
    (4.04, 5.75),
    (0.5, 0.6),
    ((1.9, 6.2), (3.1, 8.4)),
    (0.0, 0.0),
    True,
    False,
)
ALONE = replace(
    replace(AGREED, x_mm=405.0, y_mm=95.0, shown_by=(0,), agrees=False, power=0.97, agreed_near_mm=(330.0, 90.0, 75.2)),
    p_value=(0.002, 0.006),
    sensitivity_um_per_K=(3.76, 7.8),
    sensitivity_u_um_per_K=(0.08, 0.85),
    sensitivity_interval_um_per_K=((3.4, 4.1), (-1.2, 16.8)),
    lag_s=(0.0, 600.0),
    separate=True,
)
CHANNEL = ChannelAgreement("joint", "attributable", 330.0, 90.0, 0.004, (4.04, 5.75), (0.0, 0.0))
FOUND = "as found (before the repair)"


def with_places(pairs, *sources):
    """The first comparison alone, of tests that show these sources."""
    return [replace(pairs[0], places=PlaceComparison(xr.Dataset(), [CHANNEL], list(sources)))]


def described(pairs, *sources):
    compared = with_places(pairs, *sources)
    found = describe_places(compared, compared[0])
    return found, [row.cells for row in found["table"].rows]


def test_a_neighbouring_place_is_told_apart_and_reconciled(pairs):
    found, (first, second) = described(pairs, ALONE, AGREED)
    assert (first[0], second[0]) == ("place 1", "place 2")
    assert first[-1].startswith(f"shown by the test {FOUND} only; ") and "a different one: 3.8 and 7.8" in first[-1]
    assert "75 mm both agree (place 2)" in first[-1]
    assert second[-1].startswith("both tests agree here, but it is not a separate source")
    assert found["said"][0] == "No place is a heat source of its own in both tests."
    assert found["said"][1].startswith("Both agree in place 2 (x 330 mm, y 90 mm")
    assert found["said"][2] == f"Only the test {FOUND} shows place 1." and found["repeated"] == []


def test_what_one_test_shows_alone_has_the_chance_of_the_other(pairs):
    missed = replace(ALONE, p_value=(0.002, 0.6), agreed_near_mm=None, shown_by=(0,), power=0.31)
    _, ((*_, shown, verdict),) = described(pairs, missed)
    assert verdict.startswith(f"shown by the test {FOUND} only; ") and verdict.endswith("a probability of 31 %")
    assert shown == "p 0.6, 7.8 [−1.2 to 16.8] µm/K, lag 10 min"


def test_a_place_that_both_tests_show_repeats(pairs):
    found, ((*_, verdict),) = described(pairs, replace(AGREED, separate=True))
    assert verdict.startswith("repeats: both tests agree") and len(found["repeated"]) == 1
    assert found["said"][0].startswith("The drift follows the same place in both tests: place 1")
    assert "a part that no camera sees" in " ".join(found["said"])
    assert found["rows"][0][1].endswith("larger p of both 0.004, 4.0 and 5.8 µm/K")
    nothing, rows = described(pairs)
    assert rows == [] and nothing["said"][0].startswith("Neither test shows a source")


def test_the_page_escapes_titles_and_links_both_reports(pairs):
    titled = pairs[0].before.results.model_copy(update={"campaign": "Monday <1>"})
    (pair,) = with_places(pairs, ALONE, AGREED)
    pair = replace(pair, before=replace(pair.before, results=titled))
    page = render_comparison([pair], reports=["monday/report.html", "tuesday/report.html"])
    assert "Monday &lt;1&gt;" in page and "<1>" not in page
    assert 'href="monday/report.html"' in page and 'href="tuesday/report.html"' in page
    assert "No place is a heat source of its own in both tests." in page
