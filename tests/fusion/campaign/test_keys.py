"""Every key of the campaign file follows from its declaration: form, draft of init, sheet and reference."""

import importlib.util
import re
import tomllib
from datetime import date
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from fusion.app.setup.campaign import CampaignText
from fusion.app.setup.editor import form_fields, read_fields, write_fields
from fusion.campaign.config import ReportTable, Table, campaign_schema
from fusion.campaign.draft import Asker, write_campaign
from fusion.campaign.schema import Key, keys_of, known_keys
from fusion.campaign.values import QuantityError, split_uncertainty
from fusion.pipeline.iso230 import state_conditions
from fusion.report.sheet import Stated
from fusion.results.numbers import print_unit
from fusion.results.results import in_this_schema
from fusion.twin.recipe_file import recipe_schema
from tests.fusion.campaign_parts import write_laser

ROOT = Path(__file__).resolve().parents[3]
KEYS = list(known_keys().values())
ON_THE_SHEET = [one for one in KEYS if one.table[0] in ("acceptance", "report", "thermal_test")]


def typed(key: Key) -> str:
    """Return what somebody may type for a key; where the picture is the plan, other keys of it are gone."""
    if key.options:
        return key.options[0 if key.name == "plan.registration" else -1]
    return key.example or {"list": "a, b", "number": "1"}.get(key.kind, "text")


def test_every_key_of_the_schema_is_known_but_those_that_are_drawn_or_chosen_in_a_table():
    def keys(table, model):
        for key, given in model["properties"].items():
            found = [one for one in (given, *given.get("anyOf", ())) if "$ref" in one or "items" in one]
            named = [one.get("$ref") or one["items"].get("$ref") for one in found]
            named += [given["additionalProperties"].get("$ref")] if key == "tilts" else []
            inner = schema["$defs"].get((named[0] or "").rpartition("/")[2], {}) if named else {}
            yield from keys((*table, key), inner) if "properties" in inner else [".".join((*table, key))]

    schema = campaign_schema()
    fields = {".".join((*field.table, field.key)) for field in known_keys().values()}
    apart = set(keys((), schema)) - fields
    assert {name for name in apart if not name.startswith("thermography.region.")} == {
        "record.columns", "drivers.columns",
    }  # fmt: skip


def test_a_key_is_named_with_its_unit_and_takes_its_own_example() -> None:
    for key in KEYS:
        assert key.label and "_" not in key.label, key.name
        assert not key.unit or f"({print_unit(key.unit)})" in key.shown, key.name
        value, _ = split_uncertainty(key.example)
        assert key.check(value) == value, key.name
        if key.kind in ("quantity", "date"):
            with pytest.raises(QuantityError):
                key.check("5 kg")


def test_a_key_is_shown_written_and_read_back_by_the_form() -> None:
    for key in KEYS:
        tables = dict.fromkeys(".".join(table) for table in ((key.table[0],), *key.within, *filter(None, [key.of[:1]])))
        campaign = CampaignText(
            Path("campaign.toml"), "".join(f"[{table}]\n" for table in tables if table not in ROWS), None
        )
        field = key._replace(line=0) if key.row else key
        assert read_fields(campaign)[field.name] == (key.options[0] if key.options else ""), key.name
        written = write_fields(campaign, {**NAMES.get(key.table, {}), field.name: typed(key)})
        assert read_fields(written)[field.name] == typed(key), key.name
        assert not key.of or field.name not in form_fields(CampaignText(Path("campaign.toml"), "", None)), key.name


#: Tables with lines, and what a line of them cannot be without.
ROWS = ("report.instrument", "thermal_test.tilts")
NAMES = {("thermal_test", "tilts"): {"thermal_test.tilts.0.name": "A"}}


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    spec = importlib.util.spec_from_file_location("reference_pages", ROOT / "docs/_extensions/reference_pages.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def reference(pages: ModuleType) -> str:
    return str(pages.campaign_page(campaign_schema()))


def test_every_key_of_campaign_file_and_recipe_has_a_meaning_and_its_unit(pages: ModuleType, reference: str) -> None:
    recipe = str(pages.schema_page(recipe_schema()))
    rows = re.findall(r"^\| `(\w+)` \|(?: (.*) \| (.*) \|)? (.*) \|$", reference + recipe, re.MULTILINE)
    assert len(rows) > 300
    assert [key for key, *_, said in rows if said.lower().replace(" ", "_") in ("", key)] == []
    for model in Table.__subclasses__():
        for name, field in model.model_fields.items():
            if field.alias != name and (unit := name.removeprefix(f"{field.alias}_")) != "px":
                assert (
                    f"| `{field.alias}` | {'list of 2: ' * ('tuple' in str(field.annotation))}number with unit, as `"
                    in reference
                ), unit


def test_a_key_is_described_in_the_reference(pages: ModuleType, reference: str) -> None:
    for key in KEYS:
        # The name of tilts is that of their table.
        described = re.search(rf"^\| `{key.key}` \|.*{re.escape(pages.cell(key.label))}", reference, re.MULTILINE)
        assert described or (key.table == ("thermal_test", "tilts") and key.key == "name"), key.name


@pytest.fixture(scope="module")
def drafted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """What the drafts of a test of each kind say below what was measured, with their examples taken out of the comments."""
    laser, record = write_laser(tmp_path_factory.mktemp("laser") / "test", 6, 5), tmp_path_factory.mktemp("record")
    laser.unlink()
    rows = [f"{60 * k},{20 + k / 9:.2f},{k / 3:.2f},{k / 5:.2f}" for k in range(300)]
    (record / "log.csv").write_text("\n".join(["time [s],T1 [degC],Y1 [um],Y2 [um]", *rows]) + "\n")
    found = {}
    for kind, folder in (("interferometry", laser.parent), ("record", record)):
        text = write_campaign(folder, Asker(None))[0].read_text(encoding="utf-8")
        start = min(text.index(f"# [{table}]") for table in ("acceptance", "report") if f"# [{table}]" in text)
        assert not {"acceptance", "report", "thermal_test"} & tomllib.loads(text).keys()
        found[kind] = tomllib.loads(re.sub("(?m)^# ", "", text[start:]))
    return found


def test_a_key_of_a_sheet_stands_in_the_draft_of_its_tests(drafted: dict[str, dict[str, Any]]) -> None:
    assert drafted["record"]["thermal_test"]["tilts"]["A"]["channels"] == ["Y1", "Y2"]
    for key in (one for one in ON_THE_SHEET if one.table != ("thermal_test", "tilts")):
        for kind in ("record",) if key.table[0] == "thermal_test" else drafted:
            found: Any = drafted[kind]
            for name in key.table:
                found = found.get(name, {})
            found = found[0] if isinstance(found, list) else found
            assert (key.key in found) is (not key.of or kind in key.of), key.name


@pytest.mark.parametrize("kind", ["interferometry", "record"])
def test_every_key_of_the_report_is_a_condition_under_its_own_name(kind: str) -> None:
    keys = [one for one in keys_of("report", of=kind) if one.unit != "degC"]
    stated = {one.key: 5.0 if one.unit else "text" for one in keys} | {"instrument": [], "remarks": None}
    rows = {row.key: row for row in state_conditions(keys, stated, "1 May", "X", {})}
    assert rows.keys() == {"date", "axis", "instrument", *(one.key for one in keys)}
    for one in keys:
        assert rows[one.key].name == one.label
        assert rows[one.key].text == ("" if one.key == "remarks" else f"5 {one.unit}" if one.unit else "text")


def test_other_names_of_conditions_empty_no_sheet() -> None:
    stated = ReportTable(operator="R. Meyer", approved_by="J. Doe", machine="Mill").model_dump(by_alias=True)
    stated["instrument"] = [
        {"name": "laser", "serial_number": "", "calibrated": date(2026, 1, 5), "certificate": ""},
    ]
    rows = state_conditions(keys_of("report", of="record"), stated, "1 May", "X", {})
    sheet = Stated.of(rows, "none")
    other = Stated.of([row.model_copy(update={"name": f"Reworded: {row.name}"}) for row in rows], "none")
    for one, reworded in ((sheet.identity, other.identity), (sheet.conditions, other.conditions)):
        assert [text for _, text in one] == [text for _, text in reworded]
    assert sheet.signatures == other.signatures == [("Measured by", "R. Meyer"), ("Approved by", "J. Doe")]
    assert sheet.identity[-1] == ("Sign convention", "none") and ("Remarks", "not stated") in sheet.conditions


def test_conditions_of_earlier_results_get_their_keys() -> None:
    names = {
        "Report number": "report_number", "Machine": "machine", "Serial number of the machine": "machine_serial_number",
        "Date of the test": "date", "Axis": "axis", "Instruments": "instrument", "Instrument 2": "instrument", "Approved by": "approved_by",
        "Sign convention": "sign_convention", "Expansion coefficient": "expansion_coefficient", "Remarks": "remarks",
    }  # fmt: skip
    old = {"schema": 3, "iso230_3": [{"conditions": [{"name": name, "text": ""} for name in names]}]}
    assert [one["key"] for one in in_this_schema(old)["iso230_3"][0]["conditions"]] == list(names.values())
