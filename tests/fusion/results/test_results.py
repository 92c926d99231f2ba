"""results.json: the models accept what a run writes and nothing else, and give it back value for value."""

from __future__ import annotations

import ast
import json
from copy import deepcopy
from functools import cache
from pathlib import Path
from string import Formatter
from typing import Any

import jsonschema
import numpy as np
import pytest
from pydantic import ValidationError

from fusion.pipeline.thermal import _FRAME_ATTRIBUTES
from fusion.results.loop import AxisLoop, Coefficient, RecordLoop
from fusion.results.results import Notice, Results, ResultsError, assemble, read_results, results_schema
from fusion.results.store import plain
from tests.fusion.results_sample import PARTS, RECORD_LOOP
from thermofuse.resources import vocabulary

pytestmark = pytest.mark.long


@cache
def schema() -> dict[str, Any]:
    return results_schema()


@cache
def validator() -> jsonschema.Draft202012Validator:
    jsonschema.Draft202012Validator.check_schema(schema())
    return jsonschema.Draft202012Validator(schema())


def test_a_full_document_keeps_the_schema_and_the_order_of_the_design() -> None:
    document = assemble("A", PARTS, [Notice("clock", "the clocks disagree", "set clock_offset")]).as_json()
    validator().validate(document)
    assert list(document) == ["schema", "campaign", "warnings", *PARTS]
    notice = {"code": "clock", "message": "the clocks disagree", "remedy": "set clock_offset", "effect_um": None}
    assert document["warnings"] == [notice]


@pytest.mark.parametrize("parts", [PARTS, {"loop": RECORD_LOOP}], ids=["instruments", "record"])
def test_every_value_comes_back(parts: dict[str, Any]) -> None:
    document = {"schema": 4, "campaign": "A", "warnings": [], **parts}
    assert assemble("A", parts, []).as_json() == document
    assert isinstance(assemble("A", parts, []).loop, AxisLoop if "drift" in parts else RecordLoop)
    validator().validate(document)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("loop", "verdict"), "perfect"),
        (("anomalies", 0, "cause"), "magic"),
        (("anomalies", 0, "target"), 0),
        (("anomalies", 0, "direction"), "up"),
        (("iso230", "B_um"), 1.0),
        (("drift", "profile_um"), [1.0]),
        (("schema",), 2),
        (("hotspots", 0, "colour"), "red"),
    ],
)
def test_the_schema_refuses_what_the_design_does_not_know(path: tuple[Any, ...], value: object) -> None:
    document = deepcopy(assemble("A", PARTS, []).as_json())
    place: Any = document
    for part in path[:-1]:
        place = place[part]
    place[path[-1]] = value
    assert not validator().is_valid(document)
    with pytest.raises(ValidationError):
        Results.model_validate(document)


def test_every_field_is_described() -> None:
    tables = {"results": schema(), **schema()["$defs"]}
    bare = [
        f"{name}.{key}"
        for name, part in tables.items()
        for key, field in part.get("properties", {}).items()
        if not field.get("description")
    ]
    assert bare == []


def test_results_are_read_back_from_a_folder(tmp_path: Path) -> None:
    written = assemble("A", PARTS, [])
    text = json.dumps(written.as_json())
    (tmp_path / "results.json").write_text(text.replace("0.35", "NaN"))
    with pytest.raises(ResultsError, match="NaN is no number of JSON"):
        read_results(tmp_path)
    (tmp_path / "results.json").write_text(text)
    read = read_results(tmp_path)
    assert read == written == read_results(tmp_path / "results.json")
    assert read.anomalies is not None and read.anomalies[0].evidence.support == ("a",)
    assert "probability_local_temperature" not in read.anomalies[0].evidence.numbers()


def test_results_print_themselves_as_the_command_does() -> None:
    results = assemble("A & B", PARTS, [Notice("clock", "the clocks disagree", "set clock_offset")])
    lines = str(results).splitlines()
    assert (lines[0], lines[-1]) == ("campaign: A & B", "warnings: 1")
    assert repr(results) == str(results)
    assert "<th>campaign</th><td>A &amp; B</td>" in results._repr_html_()


@pytest.mark.parametrize(("value", "written"), [(float("nan"), None), (0.5, 0.5)])
def test_a_number_that_is_not_determined_is_null_and_a_key_that_does_not_apply_absent(value, written) -> None:
    told = plain({"a": Coefficient(value=value, u=np.float64(0.1), unit="um")})
    assert told == {"a": {"value": written, "u": 0.1, "unit": "um"}}


def test_results_that_cannot_be_read_name_file_and_remedy(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match=r"no results.json in it; name the results folder of a finished run"):
        read_results(tmp_path)
    for text in (
        '{"schema": 4, "campaign": "A", "warnings": [], "colour": "red"}',
        '{"registration": [1], "schema": 4}',
    ):
        (tmp_path / "results.json").write_text(text)
        with pytest.raises(ResultsError, match=r"json: not the results of this version .*; run the campaign again"):
            read_results(tmp_path)


@pytest.mark.parametrize(("loop", "kind"), [(PARTS["loop"], "axis"), (RECORD_LOOP, "record")])
def test_one_wrong_value_is_one_fault_with_its_place(tmp_path: Path, loop: dict[str, Any], kind: str) -> None:
    document = {"schema": 4, "campaign": "A", "warnings": [], "loop": {**loop, "verdict": "perfect"}}
    with pytest.raises(ValidationError) as caught:
        Results.model_validate(document)
    assert [fault["loc"] for fault in caught.value.errors()] == [("loop", kind, "verdict")]
    (tmp_path / "results.json").write_text(json.dumps(document))
    with pytest.raises(ResultsError, match=r"thermofuse \(loop.verdict: Input should be 'complete'.*'no_skill'\); run"):
        read_results(tmp_path)


def test_a_drift_that_lacks_a_target_is_refused(tmp_path: Path) -> None:
    drift = {**PARTS["drift"], "position_mm": [0.0, 150.0], "range_um": [1.0, 2.0], "range_u_um": [0.1, 0.1]}
    content = assemble("X", {**PARTS, "drift": drift}, []).as_json()
    content["drift"]["range_u_um"] = [0.1]
    (tmp_path / "results.json").write_text(json.dumps(content))
    with pytest.raises(ResultsError, match="have one value for each target"):
        read_results(tmp_path)


def test_very_many_faults_are_counted_alone_and_long_places_are_cut(tmp_path: Path) -> None:
    """Written out, each of a million faults would take a kilobyte."""
    document = {"schema": 4, "campaign": "A", "warnings": [1] * 2_000}
    (tmp_path / "results.json").write_text(json.dumps(document))
    with pytest.raises(ResultsError, match=r"\(2000 values are invalid\); run the campaign again"):
        read_results(tmp_path)
    (tmp_path / "results.json").write_text(json.dumps({**document, "warnings": [], "k" * 5_000: 1}))
    with pytest.raises(ResultsError, match=r"\(k{200}: Extra inputs") as caught:
        read_results(tmp_path)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    ("key", "value"),
    [("zone", "x"), ("zone", "../../etc/passwd"), ("zone", "x" * 5_000), ("first", "today"), ("last", "99999-99-99")],
)
def test_times_and_zones_that_are_none_are_refused(tmp_path: Path, key: str, value: str) -> None:
    """The report writes times of day in that zone."""
    time = {"first": "2026-03-09T06:30:00Z", "last": "2026-03-09T16:30:00Z", "zone": "Europe/Berlin"}
    document = {"schema": 4, "campaign": "A", "warnings": [], "time": time}
    assert Results.model_validate(document).time is not None
    (tmp_path / "results.json").write_text(json.dumps({**document, "time": {**time, key: value}}))
    with pytest.raises(ResultsError, match=rf"\(time\.{key}: "):
        read_results(tmp_path)


@pytest.mark.parametrize("kind", ["axis", "record"])
@pytest.mark.parametrize("schema", [1, 2, 3])
def test_an_older_schema_is_read_under_the_names_of_this_one(tmp_path: Path, kind: str, schema: int) -> None:
    """The samples hold every renamed key; a fiducial and a channel named like one keep their name; the quoted window comes to the top."""
    document = json.loads(Path(__file__).with_name(f"schema_2_{kind}.json").read_text(encoding="utf-8"))
    if kind == "axis":
        document["iso230"]["settled"]["A_um"]["value"] = 15.4
    (tmp_path / "results.json").write_text(json.dumps({**document, "schema": schema}))
    results = read_results(tmp_path)
    validator().validate(results.as_json())
    assert results.schema_version == 4 and results.loop is not None
    if isinstance(results.loop, RecordLoop):
        assert set(results.loop.channels) == {"nuisance"}
        assert set(results.loop.unexplained.p_values) == {"autocorrelation", "periodicity", "switching"}
        return
    assert results.registration is not None and set(results.registration.leave_one_out_mm) == {"nearest"}
    assert (
        results.iso230 is not None and results.iso230.window == "cycles 6 to 10" and results.iso230.A_um.value == 15.4
    )
    assert results.iso230.first is not None and results.iso230.first.A_um.value == 1.0
    assert "single_target" in results.loop.residual_tests.final.p_values
    assert set(results.loop.unconfirmed_effects) == set(results.loop.not_admitted) == {"dead_path"}
    assert results.correlation is not None and results.correlation.sensors.block_length_s == 3717.0


def test_a_schema_of_the_future_is_refused(tmp_path: Path) -> None:
    (tmp_path / "results.json").write_text(json.dumps({"schema": 5, "campaign": "A", "warnings": []}))
    with pytest.raises(ResultsError, match="schema: Input should be 4"):
        read_results(tmp_path)


def test_results_of_a_folder_show_their_report(tmp_path):
    results = assemble("A", PARTS, [])
    with pytest.raises(ResultsError, match=r"no report\.html"):
        results.report()
    (tmp_path / "report.html").write_text('<p class="a">R & D</p>', encoding="utf-8")
    report = results.of_folder(tmp_path).report()
    assert report.path == tmp_path / "report.html" and results == assemble("A", PARTS, [])
    assert 'srcdoc="&lt;p class=&quot;a&quot;&gt;R &amp; D&lt;/p&gt;"' in report._repr_html_()


def test_every_notice_finds_its_words_and_gives_all_their_facts() -> None:
    """A fact that is lacking would end a run in its notice, and words that no notice takes are said by nobody."""
    words, said = vocabulary("notices"), {*_FRAME_ATTRIBUTES, "camera_creeps"}
    for path in Path("fusion").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.Call)
                and ast.unparse(node.func) in ("Notice.of", "_notice")
                and isinstance(node.args[0], ast.Constant)
            ):
                name = str(node.args[0].value)
                said.add(name)
                needed = {fact for text in words[name].values() for _, fact, _, _ in Formatter().parse(text) if fact}
                given = {keyword.arg for keyword in node.keywords} - {"code", "effect_um"}
                assert needed - {"effect_um"} == given, f"{path}, line {node.lineno}"
    assert said == {*words}
