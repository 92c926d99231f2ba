"""Findings of a run: each on every surface that shows it, with one number; what is doubted stands beside what rests on it."""

from __future__ import annotations

import io
import math
import re
from html import unescape
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from fusion.pipeline.consistency import inputs_part
from fusion.report.campaign import describe_campaign
from fusion.report.exports.tables import findings_table
from fusion.report.findings import Finding, brief_rows, findings, sharpen, summary_rows, summary_table
from fusion.report.fleet import Row, with_findings
from fusion.report.page import render_page
from fusion.results.parts import Quantity
from fusion.results.results import Notice, Results, assemble
from fusion.results.store import write_json
from tests.fusion.report.test_campaign import ORIGIN
from tests.fusion.report.test_fleet import PICTURES
from tests.fusion.report.test_record import record
from tests.fusion.results_sample import MOVED, PARTS, RECORD_LOOP, told

DRIFT = {**PARTS["drift"], "position_mm": [0.0, 150.0], "range_um": [3.1, 11.127], "range_u_um": [0.1, 0.17]}
FIELD = {
    "fields": 9, "frames": 9, "duration_s": 60.0, "mean_rise_K": {"value": 1.05, "u": 0.2}, "largest_rise_K": {"value": 2.0, "u": 0.2},
    "largest_cycle": 9, "largest_after_s": 60.0, "largest_x_mm": 1.0, "largest_y_mm": 1.0,
}  # fmt: skip
RUN = {
    "file": "run 2",
    "held_out": True,
    "duration_h": 5.0,
    "blocks": 60,
    "verdict": "explained",
    "rmse_persistence_um": 0.9,
}
RUNS = [{**RUN, "rmse_declared_um": 0.6, "rmse_final_um": 0.4}]
LATE = [Notice("clock", "The clocks disagree.", "Set clock_offset.")]
AXIS = {name: part for name, part in PARTS.items() if name not in ("registration", "hotspots")}
#: Results of an axis with a camera, of a laser alone, of a record, and of a camera alone; and what their products hold.
SAMPLES: dict[str, tuple[Results, dict[str, Any]]] = {
    "axis": (assemble("A", {**AXIS, "drift": DRIFT, "field": FIELD}, LATE), {}),
    "laser": (assemble("L", {"iso230": PARTS["iso230"]}, []), {}),
    "record": (assemble("R", {"loop": {**RECORD_LOOP, "runs": RUNS}, "iso230_3": [MOVED]}, []), {"record": record()}),
    "camera": (assemble("C", PICTURES, []), {}),
}
#: What each of them says, in its order; doubled are those of several steps, values and regions.
CODES = {
    "axis": (
        "quoted A R E M B drift scatter verdict how_much where how_sure what_remains declared added held_out plain_predictions "
        "noise_floor next warning"
    ),
    "laser": "quoted quoted quoted quoted A R E M B how_much next",
    "record": (
        "drift verdict how_sure what_remains declared added held_out plain_predictions noise_floor unexplained run_line next"
    ),
    "camera": "highest lowest mean region_line next",
}


def one_line(text: str) -> str:
    """A text without marks and frames, on one line."""
    return " ".join(unescape(re.sub("</?[a-zA-Z!][^>]*>|[─-╿]", " ", text)).split())


@pytest.fixture(scope="module")
def surfaces(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """What each surface shows of every sample."""
    shown = {}
    for name, (results, products) in SAMPLES.items():
        folder, printed = tmp_path_factory.mktemp(name), io.StringIO()
        write_json(folder / "results.json", results.as_json())
        Console(width=5000, file=printed).print(summary_table(results))
        summary = describe_campaign(results, ORIGIN, products, None)
        given = {"results": results, "provenance": ORIGIN, "summary": summary, "thermal_map": None}
        shown[name] = {
            "page": one_line(render_page("report.html.j2", {}, **given)),
            "terminal": one_line(printed.getvalue()),
            "workbook": dict(zip(*findings_table(results)[["finding", "value"]].T.values, strict=True)),
            "fleet": with_findings(Row(name, state="finished"), folder),
        }
    return shown


EVERY = [
    pytest.param(name, one, id=f"{name}-{at}-{one.code}")
    for name, (results, _) in SAMPLES.items()
    for at, one in enumerate(findings(results))
]


@pytest.mark.parametrize("name", SAMPLES)
def test_findings_come_in_the_order_of_the_report(name: str) -> None:
    assert [one.code for one in findings(SAMPLES[name][0])] == CODES[name].split()


@pytest.mark.parametrize(("name", "one"), EVERY)
def test_a_finding_stands_on_every_surface_that_shows_it(
    surfaces: dict[str, dict[str, Any]], name: str, one: Finding
) -> None:
    shown = surfaces[name]
    if one.name:
        assert f"{one.name} {one_line(one.text)}" in shown["terminal"]
        assert one.text in shown["workbook"][one.name]
    if one.tile:
        assert " ".join(one.tile).strip() in shown["page"]
    if one.value is not None and hasattr(shown["fleet"], key := f"{one.code}_{one.unit}"):
        assert getattr(shown["fleet"], key) == one.value.value
        assert getattr(shown["fleet"], f"{one.code}_u_{one.unit}", None) == one.value.u
    assert one.name or one.tile or one.value


@pytest.mark.parametrize("name", ["axis", "record"])
def test_numbers_of_a_fleet_are_findings(surfaces: dict[str, dict[str, Any]], name: str) -> None:
    stated = {f"{one.code}_{one.unit}" for one in findings(SAMPLES[name][0]) if one.value}
    columns = {"drift_um", "held_out_um", *(f"{symbol}_um" for symbol in "AREMB")}
    assert {key for key in columns if getattr(surfaces[name]["fleet"], key) is not None} == stated


def test_a_doubt_stands_beside_every_finding_that_rests_on_it():
    checks = [told("datum", passed=False)]
    rows = dict(summary_rows(assemble("A", {**PARTS, "inputs": inputs_part(checks, ())}, [])))
    condition = "(only if the datum of the laser stayed the same)"
    touched = {name for name, text in rows.items() if condition[1:-1] in text.lower()}
    of_laser = "verdict, how much, where, how sure, scatter per position, added, held-out error, plain predictions, noise floor, next"
    assert touched == set(of_laser.split(", "))


def test_what_is_not_verified_is_said_with_what_would_confirm_it():
    checks = [told("material_rise", passed=True, verified=False)]
    results = assemble("A", {**PARTS, "inputs": inputs_part(checks, ())}, [])
    rows = dict(summary_rows(results))
    assert rows["inputs"] == "sound in 1 checks\nnot verified: It is off. Check it."
    assert rows["next"].endswith("3. Check it."), "what is inspected on the machine comes first"
    assert results.inputs.state == "sound" and results.inputs.assumptions("field") == ("the emissivity is right",)
    # A scale that all share makes no cause right or wrong.
    assert results.inputs.assumptions("positions", "attribution", "causes") == ()
    accepted = assemble("A", {**PARTS, "inputs": inputs_part(checks, ("material_rise",))}, [])
    assert accepted.inputs.unverified == ()


def test_an_exact_fit_is_not_printed_as_accuracy():
    part = {**PARTS["registration"], "rms_mm": None, "position_u_mm": 0.87, "leave_one_out_mm": dict.fromkeys("ABCD")}
    rows = dict(summary_rows(assemble("four discs", {**PARTS, "registration": part}, [])))
    assert rows["registration"] == ("standard uncertainty 0.87 mm, not checked: 4 fiducials determine the plan exactly")


@pytest.mark.parametrize(
    ("positive", "negative", "stated"),
    [
        ((0.4, None), (0.2, 0.3), "0.20 to 0.40 µm, median 0.30 µm"),
        ((0.4, 0.0), (0.2, 0.3), "up to 0.40 µm, median 0.25 µm"),
        ((None,), (None,), "not known: no position has enough readings"),
    ],
)
def test_scatter_leaves_out_what_is_not_determined(positive, negative, stated):
    drift = {**PARTS["drift"], "scatter_um": {"positive": positive, "negative": negative}}
    assert dict(summary_rows(assemble("A", {**PARTS, "drift": drift}, [])))["scatter per position"] == stated


def test_plain_predictions_are_last_value_mean_and_the_best_regression():
    results = assemble("A", PARTS, [])
    best = results.loop.model_copy(update={"best_baseline": "mean", "steps": ()})
    rows = dict(summary_rows(results.model_copy(update={"loop": best})))
    assert rows["plain predictions"].count(", ") == 1 and "->" not in rows["held-out error"]


def budget(*terms: tuple[str, float, float | None, str], side: str = "") -> SimpleNamespace:
    """A of 10 um with U = 4 um, limit 8 um, and its contributions: name, term of A, input u, origin."""
    a_um = Quantity(value=10.0, u=2.0)
    told = [
        SimpleNamespace(
            contributor=name, u=u, origin=origin, A_um=None if side else term, unidirectional_um={f"A_{side}": term}
        )
        for name, term, u, origin in terms
    ]
    one_way = SimpleNamespace(A_um=a_um)
    return SimpleNamespace(
        approach=side, unit="um", cycles=(1, 2, 3, 4, 5), A_um=Quantity(value=None, u=None) if side else a_um,
        positive=one_way, negative=one_way, contributions=told,
        tolerances=[SimpleNamespace(quantity="B", limit_um=20.0), SimpleNamespace(quantity="A", limit_um=8.0)],
        conditions=[SimpleNamespace(key="remarks", text="5 runs"), SimpleNamespace(key="expansion_coefficient", text="11.7 ppm/K")],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("part", "found"),
    [
        (None, None),
        (budget(), None),
        (
            budget(("sampling", 0.6, 0.6, "readings"), ("expansion_coefficient", 1.9, 2.0, "assumed, 2 ppm/K")),
            ("A", "expansion_coefficient", 0.9025, 'expansion_coefficient = "11.7 +- 0.3 ppm/K"', 1.3730, "fail", 0),
        ),
        # A stated coefficient, and one whose uncertainty is as good as stated, cannot be sharpened.
        (budget(("expansion_coefficient", 2.0, 2.0, "stated")), ("A", "expansion_coefficient", 1.0, "", math.inf, "", 0)),
        (budget(("material_temperature", 2.0, 0.12, "assumed")), ("A", "material_temperature", 1.0, "", math.inf, "", 0)),
        (
            budget(("sampling", 1.6, 1.6, "readings"), ("extremes", 0.8, 0.8, "readings"), side="negative"),
            ("A↓", "sampling", 0.64, "", 2.5298, "", 20),
        ),
    ],
)  # fmt: skip
def test_the_uncertainty_of_a_is_sharpened_where_most_of_it_is_assumed_or_scatter(
    part: Any, found: tuple[Any, ...] | None
) -> None:
    told = sharpen(part)
    stated = told and (
        told.symbol, told.contributor, told.share, told.line, told.sharper_um, told.decision, told.cycles
    )  # fmt: skip
    assert stated == (found and tuple(pytest.approx(one, rel=1e-4) if isinstance(one, float) else one for one in found))
    assert told is None or told.expanded_um == 4.0


@pytest.mark.parametrize(
    ("name", "figures", "said"),
    [
        (
            "axis",
            "A 1.00 ± 0.20 µm; Largest drift 11.13 ± 0.34 µm; Held-out error 0.40 µm",
            "1. Look up cycle 9 in the logs of machine and sensors.\n2. Position 3: c.",
        ),
        (
            "laser",
            "A 1.00 ± 0.20 µm; R 1.00 ± 0.20 µm; B 1.00 ± 0.20 µm; M 1.00 ± 0.20 µm",
            "1. Nothing has to be done.",
        ),
        (
            "record",
            "Largest drift 89.2 ± 1.8 µm; Held-out error 0.40 µm; Unexplained variance 10 %",
            "1. Ask whether the laser was zeroed or its beam broken at that time.",
        ),
        (
            "camera",
            "Highest > 312 °C; Lowest 16.4 ± 2.4 °C; Mean 31.7 ± 2.6 °C",
            "1. Nothing has to be done; use the temperatures as they are, with their uncertainty.",
        ),
    ],
)
def test_the_terminal_shows_what_the_first_screen_says(name: str, figures: str, said: str) -> None:
    rows = dict(brief_rows(SAMPLES[name][0]))
    assert rows["figures"] == figures and rows["next"] == said
    alone = "Highest temperature" if name == "camera" else None
    assert rows.get("temperature", "").startswith(alone or "") and ("decision" in rows) is (alone is None)


@pytest.mark.parametrize(("cameras", "lines"), [("C", ["whole picture", "spot", "whole picture"]), ("CB", ["B", "C"])])
def test_every_region_has_its_line_and_of_several_cameras_every_picture(cameras: str, lines: list[str]) -> None:
    (whole,), pictures = PICTURES["regions"], PICTURES["thermograms"]
    regions = [whole | {"camera": "B", "maximum_degC": {"value": 99.0, "u": None}}, whole | {"name": "spot"}, whole]
    of_each = [pictures["cameras"][0] | {"name": name} for name in cameras]
    found = findings(assemble("C", {"thermograms": pictures | {"cameras": of_each}, "regions": regions}, []))
    assert [one.name for one in found if one.code == "region_line"] == lines
    assert found[0].code == "highest" and found[0].tile is not None and found[0].tile.value == "> 312 °C"
