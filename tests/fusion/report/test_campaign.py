"""The report of a campaign and its page: the numbers are those of the products, every variable is escaped."""

from typing import Any

import jinja2
import numpy as np
import pytest
import xarray as xr
from markupsafe import Markup

from fusion.report import campaign as model_section
from fusion.report.campaign import describe_campaign, describe_correlation, rate_text
from fusion.report.charts.embedded import MapControls
from fusion.report.page import render_page
from fusion.report.wording import environment, region_words, table
from fusion.results.axis import CorrelationPart
from fusion.results.results import AxisLoop, Results, assemble, read_results
from fusion.results.store import group, read_grouped, read_tree
from tests.fusion.report.page_tables import tables_of
from tests.fusion.results_sample import PARTS


def test_four_standard_deviations_stand_side_by_side(results_folder):
    page = (results_folder / "report.html").read_text(encoding="utf-8")
    section = page[page.index("Standard deviations side by side") :]
    rows = section[: section.index("</table>")].split("<tr>")[1:]
    comparison = group(read_grouped(results_folder / "deviations.nc"), "comparison")
    assert [row.split("</td>")[0].split(">")[-1] for row in rows[-5:]] == ["2", "3", "4", "5", "6"]
    last = comparison.sel(link=6)
    for direction in ("positive", "negative"):
        for name in ("conventional", "differenced", "ratio", "joint"):
            assert f">{float(last[name].sel(direction=direction)):.2f}<" in rows[-1]
    # The twin's readings scatter by 0.3 um; 24 of them in each direction know that to 15 %.
    assert abs(float(comparison["joint"].median()) - 0.3) < 0.05


def test_results_without_products_still_make_a_page():
    results = assemble("A", PARTS, [])
    told = describe_campaign(results, ORIGIN, {}, None)
    assert told["verdict"] == "explained"
    assert told["anomalies"][0]["title"] == "Position 3, both approaches: mechanical scatter"
    assert told["iso230"]["axis"].rows[-2].cells[0] == "Reversal error B"
    assert told["positions"] is None and told["correlation"] is None
    page = "".join(
        render_page(f"sections/{name}.j2", {}, results=results, summary=told, thermal_map=MapControls([], [1], ""))
        for name in ("fields", "loop")
    )
    tables = tables_of(page)
    assert tables["Hotspots"][1][6:] == ["3", "–", "–"]
    limit = tables["Detection limit of every effect"][1]
    assert limit[:5] == ["dead path of the laser", "never", "–", "10 %", "refractive index of the air"]


ORIGIN = {
    "parameters": {"campaign": {}}, "inputs": {}, "versions": {"thermofuse": "1"}, "started": "", "finished": "", "command": [],
}  # fmt: skip


@pytest.fixture(scope="module")
def parts(results_folder):
    return read_tree(results_folder / "fusion.nc"), read_results(results_folder)


def correlation_of(results: Results) -> CorrelationPart:
    assert results.correlation is not None
    return results.correlation


def page_of(fused: xr.DataTree, results: Results, joint: dict[str, Any] | None = None) -> str:
    """Both sections without their charts."""
    summary = describe_campaign(results, ORIGIN, {"fusion": fused}, joint)
    sections = ("place", "correlation")
    return "".join(render_page(f"sections/{name}.j2", {}, results=results, summary=summary) for name in sections)


def test_every_mode_region_and_part_of_the_drift_has_its_row(parts):
    fused, results = parts
    correlation = correlation_of(results)
    tables = tables_of(page_of(fused, results))
    cells = tables["Strongest cell of each part of the drift"]
    assert [row[0] for row in cells[1:]] == ["common", "growing", "reversal", "common and growing"]
    strongest = tables["Thermal modes: strongest part of the drift"]
    assert len(strongest) == 1 + len(correlation.modes) and strongest[0][-1] == "p given the leading mode"
    assert len(tables["Thermal modes: all parts of the drift"]) == 1 + 4 * len(correlation.modes)
    # The disc about a hotspot is not the hotspot.
    regions = tables["Regions, and discs about the middles of hotspots: strongest part of the drift"]
    assert [row[0] for row in regions[1:]] == [region_words(region.name) for region in correlation.regions]
    assert region_words("hotspot 12") == "disc about hotspot 12" and region_words("hotspot plate") == "hotspot plate"


def test_a_further_mode_is_named_with_the_part_of_the_drift_that_it_explains(parts):
    fused, results = parts
    found = correlation_of(results)
    leading, other = found.modes[0], found.modes[1]
    given = {
        name: part.model_copy(update={"p_given_leading_mode": p, "p_value": 0.5})
        for (name, part), p in zip(other.parts.items(), (0.9, 0.03, 0.004, 0.6), strict=True)
    }
    adding = found.model_copy(
        update={
            "verdict": "attributable",
            "source": found.source.model_copy(update={"kind": "mode", "name": leading.name.removeprefix("mode ")}),
            "modes": (leading, other.model_copy(update={"parts": given})),
        }
    )
    page = page_of(fused, results.model_copy(update={"correlation": adding}))
    assert "for the drift of the reversal, p = 0.004)" in page and "significant conditional on the leading mode" in page


def test_a_place_that_two_tests_show_repeats_and_is_no_cause(parts):
    fused, results = parts
    attributable = correlation_of(results).model_copy(update={"verdict": "attributable"})
    leading = results.model_copy(update={"correlation": attributable})
    joint = {"other": "Tuesday", "repeated": ["x 1 mm, y 2 mm"], "rows": [], "table": table([], [])}
    page = page_of(fused, leading, joint)
    assert "The test Tuesday shows the same: x 1 mm, y 2 mm (below)" in page and "a cause" not in page
    assert "The test Tuesday does not show the same" in page_of(fused, leading, {**joint, "repeated": []})


def test_sensors_that_lose_more_than_fewer_are_named(parts):
    fused, results = parts
    told = describe_correlation(fused, results, None)
    losses = [np.inf if one.loss_um is None else one.loss_um for one in correlation_of(results).sensors.sets]
    expected = [k > 0 and loss > min(losses[:k]) for k, loss in enumerate(losses)]
    assert [fewer for _, fewer in told["sensors"]] == expected


def test_a_page_needs_the_variables_of_its_template():
    with pytest.raises(jinja2.UndefinedError, match="results"):
        render_page("report.html.j2", {})


def test_names_do_not_turn_the_direction_of_the_text_around_them():
    template = environment(html=True).from_string(
        '{% macro cell(text) %}<td title="{{ text }}">{{ text }}</td>{% endmacro %}{{ cell(name) }}{{ own }}{{ count }}'
    )
    page = template.render(name="x\u202egpj.\n<b>\x1b[2J", own=Markup("<i>\u2192</i>"), count=3)
    name = "x\\u202egpj.\n&lt;b&gt;\\x1b[2J"
    assert page == f'<td title="{name}">{name}</td><i>→</i>3'


RESULTS = assemble("A", PARTS, [])
LOOP = RESULTS.loop


assert isinstance(LOOP, AxisLoop)


def test_steps_start_with_the_declared_model_and_a_doubt_has_its_reason():
    declared, added = model_section.steps_table(LOOP).rows
    assert declared.cells == ["0", "declared: expansion of the axis", "\u2013", "0.60", "\u2013", "", ""]
    assert added.marked
    told = "sudden step or new zero: 1.00 ± 0.20 µm, 30 min after the start (at least 28 min), shape flat (or linear)"
    assert added.cells[1:3] == [told, "< 0.001"]
    assert added.cells[3:6] == ["0.60 → 0.40", "0.70 → 0.50", "yes"]
    assert added.cells[-1] == "dead path of the laser (log-likelihood lower by 4.0)"
    doubted = LOOP.steps[0].model_copy(update={"confirmed": False, "doubt": "0.4 µm without it, 0.5 µm with it"})
    _, added = model_section.steps_table(LOOP.model_copy(update={"steps": (doubted,)})).rows
    assert added.cells[5] == "not confirmed: 0.4 µm without it, 0.5 µm with it"  # results of earlier versions


def test_the_model_and_its_errors_are_told_in_numbers():
    rows = [row.cells for row in model_section.errors_table(LOOP).rows]
    assert rows[:3] == [
        ["declared model", "0.60", "–"],
        ["with the added effects", "0.40", "0.39 [0.35 to 0.43]"],
        ["last cycle simply repeated", "0.90", "–"],
    ]
    assert len(rows) == 7
    refused = LOOP.model_copy(
        update={"not_admitted": {"thermal_lag": "noise"}, "unconfirmed_effects": {"thermal_lag": 9e-35}}
    )
    (reason,) = (text for name, text in model_section.refused_effects(refused) if name.startswith("not admitted"))
    assert reason == "p < 0.001; noise"
    rows = dict(model_section.describe_model(LOOP))
    assert rows["expansion of the axis"] == "11.60 \u00b1 0.40 ppm/K (prior 11.7 \u00b1 4.0 ppm/K)"
    assert rows["sudden step or new zero"] == "1.00 \u00b1 0.20 \u00b5m"
    unexplained = rows["random drift beside the effects"]
    assert unexplained.startswith("random walk: 0.10 \u00b5m rms common") and "below 0.001 \u00b5m" in unexplained
    assert rows["not tried: dead path of the laser"] == "no air"
    assert "extra test on the held-out cycles" not in rows


def test_candidates_evidence_and_errors_are_told_with_their_numbers():
    (row,) = model_section.describe_candidates(LOOP).rows
    assert row.cells == ["1", "sudden step or new zero", "", "9.0", "8.0", "0.01", "4.0", "0.01"]
    told = model_section.describe_anomaly(RESULTS.anomalies[0])
    assert told["stands_out"] == "extra scatter of 0.30 \u00b5m"
    assert ("step, gain in log-likelihood on the other approach", "0") in told["numbers"] and (
        "step, cycle",
        "12",
    ) in told["numbers"]
    assert (told["support"], told["against"], told["check"]) == (("a",), ("b",), "c")
    step = LOOP.steps[0].model_copy(update={"rmse_before_um": 1.938, "rmse_after_um": 0.4643})
    rows = model_section.steps_table(LOOP.model_copy(update={"rmse_declared_um": 1.938, "steps": (step,)})).rows
    assert [row.cells[3] for row in rows] == ["1.94", "1.94 → 0.46"]


def test_every_coefficient_has_a_name_of_its_own():
    (step,) = LOOP.steps
    coefficient = step.coefficients[0]

    def named(effect, shape, count):
        changed = {"effect": effect, "parameters": {"shape": shape}, "coefficients": (coefficient,) * count}
        return model_section.coefficient_names(step.model_copy(update=changed))

    start = "remainder of the time before the start, shift"
    assert named("unseen_heat_source", "flat", 2) == ["shift at full load", start]
    four = named("unseen_heat_source", "flat and linear", 4)
    assert len(set(four)) == 4 and four[1] == "stretch at the far end at full load"
    assert named("thermal_lag", "flat and linear", 2) == ["shift", "stretch at the far end"]
    assert named("periodic_disturbance", "flat", 2) == ["sine part", "cosine part"]
    assert named("step_event", "flat", 1) == [""] and named("bed_bending", "", 2) == ["coefficient 1", "coefficient 2"]


def test_a_rate_carries_its_own_uncertainty():
    # Binomial: sqrt(0.05 * 0.95 / 199) = 1.54 %, and twice that is stated.
    assert rate_text(0.05) == "5.0 ± 3.1 %"
