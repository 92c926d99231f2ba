"""The sheet of a test and its section: every number equals plain arithmetic on the readings, names are escaped, nothing is replaced."""

import csv
import io
import json
import math
import re
import shutil

import docx
import numpy as np
import pytest
import xarray as xr
from PIL import Image
from playwright.sync_api import sync_playwright

from fusion.campaign.recompensation import ROTARY_BUDGET
from fusion.pipeline.iso230 import complete_sheet, evaluate_standard, files_of_run, read_test
from fusion.report.campaign import describe_iso230
from fusion.report.findings import sharpen
from fusion.report.letterhead import Letterhead, TemplateError, translation
from fusion.report.page import PageFileError
from fusion.report.sheet import (
    describe_sheet,
    iso230_csv,
    iso230_json,
    iso230_tables,
    render_iso230,
    write_iso230,
)
from fusion.report.wording import say
from fusion.results.axis import Iso230Part
from fusion.results.results import Results, in_this_schema
from fusion.results.store import joined, plain
from fusion.twin.recipe_file import packaged_recipe, read_recipe
from interferometry.drift.estimate import estimate_drift
from tests.browser import CHROMIUM
from tests.fusion.campaign_parts import without
from tests.fusion.pipeline.test_iso230 import ASSUMED
from tests.fusion.report.page_tables import tables_of
from tests.fusion.results_sample import AXIS_VALUES
from tests.interferometry.iso230.made_tests import by_hand, test_made
from tests.interferometry.simulated_campaigns import simulate

pytestmark = pytest.mark.long

X = np.random.default_rng(21).normal(0, 0.6, (5, 2, 7)) + np.array([[1.1], [-0.4]]) + 1.7 * np.arange(7.0)


def sheet_of(title: str, part: Iso230Part):
    """The sheet of a test read from a file."""
    return describe_sheet(title, part, files={"x.csv": "ab12"})


def page_of(title: str, part: Iso230Part, dataset: xr.Dataset, *remarks: str) -> str:
    """The page of a test."""
    return render_iso230(sheet_of(title, part), part, dataset, remarks=remarks)


@pytest.fixture(scope="module")
def test_sheet():
    return evaluated(X)


def evaluated(x: np.ndarray) -> tuple[Iso230Part, xr.Dataset]:
    """A sheet with its readings."""
    deviations = test_made(x)
    windows, quoted, part = evaluate_standard(deviations, ASSUMED, drift=None)
    dataset = joined(deviations, iso=windows, quoted=quoted)
    return Iso230Part.model_validate(plain(complete_sheet(part, dataset, campaign=None, environment=None))), dataset


def cells_of(page: str) -> list[list[str]]:
    """Texts of the cells of every row of every table of a page."""
    return [row for rows in tables_of(page).values() for row in rows]


def as_number(text: str) -> float:
    """The number of a cell; a bound is the largest that it allows."""
    return float(text.removeprefix("< ").replace("\u2212", "-"))


def test_the_values_of_the_axis_are_those_of_the_definitions(test_sheet):
    page = page_of("A", *test_sheet)
    mean, s, seen = X.mean(axis=0), X.std(axis=0, ddof=1), 0
    true = {**by_hand(X), "sign": (mean[0] - mean[1]).mean()}
    for m, q, arrow in zip(mean, s, "\u2191\u2193", strict=True):
        true |= {f"A{arrow}": (m + 2 * q).max() - (m - 2 * q).min(), f"R{arrow}": 4 * q.max(), f"E{arrow}": np.ptp(m)}
    for cells in cells_of(page):
        match = (
            re.fullmatch(r".*(?:accuracy|repeatability|error) ([AREMB][\u2191\u2193]?)|.*with its (sign)", cells[0])
            if cells
            else None
        )
        if match is None or len(cells) != 2:
            continue
        value, _, expanded = cells[1].partition(" \u00b1 ")
        # Half of the last printed digit.
        last = 0.5 * 10.0 ** -len(expanded.partition(".")[2])
        assert as_number(value) == pytest.approx(true[match.group(1) or match.group(2)], abs=1.001 * last), cells
        seen += 1
    # Every value once below the sheet, and those of both approaches on the sheet too.
    assert len(true) == 12 and seen == 12 + 5


def test_the_values_of_the_targets_are_those_of_the_readings(test_sheet):
    page = page_of("A", *test_sheet)
    rows = [cells for cells in cells_of(page) if len(cells) == 12 and cells[0].isdigit()]
    assert len(rows) == 7
    mean, s = X.mean(axis=0), X.std(axis=0, ddof=1)
    wide = np.max([2 * s[0] + 2 * s[1] + np.abs(mean[0] - mean[1]), 4 * s[0], 4 * s[1]], axis=0)
    values = np.array([*mean, *s, *(4 * s), mean.mean(axis=0), mean[0] - mean[1], wide])
    for i, cells in enumerate(rows):
        assert [as_number(cell) for cell in cells[:2]] == [i + 1, 10.0 * i]
        assert [as_number(cell) for cell in cells[2:11]] == pytest.approx(values[:, i], abs=0.00501)
        assert cells[11] == "5, 5"


def test_the_sums_of_the_budget_are_those_of_its_rows(test_sheet):
    rows = describe_iso230(*test_sheet)["budget"].rows
    for column in range(3, 9):
        contributions = [as_number(row.cells[column]) for row in rows[:5] if row.cells[column] != "\u2013"]
        sampling = [as_number(row.cells[column]) for row in rows[5:7]]
        without, whole = (as_number(row.cells[column]) for row in rows[7:])
        # Two significant digits are printed: 5 % of the smallest.
        assert without == pytest.approx(2 * math.hypot(*contributions), rel=0.06, abs=1e-3)
        assert whole == pytest.approx(2 * math.hypot(*contributions, *sampling), rel=0.06)


def test_json_and_csv_hold_full_precision(test_sheet):
    told = iso230_json(*test_sheet)
    assert told["A_um"]["value"] == pytest.approx(by_hand(X)["A"], rel=1e-12)
    rows = list(csv.DictReader(io.StringIO(iso230_csv(test_sheet[1]))))
    assert [float(row["mean_positive_um"]) for row in rows] == pytest.approx(X[:, 0].mean(axis=0))
    assert [float(row["B_i_um"]) for row in rows] == pytest.approx(X[:, 0].mean(axis=0) - X[:, 1].mean(axis=0))
    assert told["targets"][0]["readings_negative"] == 5


def test_missing_readings_are_named_under_the_table():
    x = X.copy()
    x[3, 1, 2] = np.nan
    page = page_of("A", *evaluated(x))
    assert "1 of 70 readings of the window are missing: cycle 4, target 3\u2193 (missing)." in page


def test_one_cycle_has_e_m_and_b_alone_and_says_why():
    part, dataset = evaluated(X[:1])
    page = page_of("A", part, dataset, "1 line left out")
    assert "One cycle has no standard deviation s" in page and "<li>1 line left out</li>" in page
    rows = [cells for cells in cells_of(page) if cells and cells[0].isdigit()]
    assert [as_number(cells[3]) for cells in rows] == pytest.approx(X[0, 1], abs=0.0051)
    assert list(csv.DictReader(io.StringIO(iso230_csv(dataset))))[6]["mean_positive_um"] == str(X[0, 0, 6])
    assert part.A_um.value is part.R_um.value is None and part.E_um.value == pytest.approx(np.ptp(X[0]))
    assert part.B_um.value == pytest.approx(np.abs(X[0, 0] - X[0, 1]).max()) and part.B_um.u is None
    # Neither limits nor a budget are judged without an uncertainty.
    assert [table.title for table in iso230_tables(part, dataset, title="A")][1:] == ["per target position"]


def test_names_from_files_are_escaped_and_no_file_is_replaced(test_sheet, tmp_path):
    page = page_of("<i>A</i>", *test_sheet, "<script>")
    assert "<i>A</i>" not in page and "<li>&lt;script&gt;</li>" in page
    sheet = sheet_of("A", test_sheet[0])
    with pytest.raises(PageFileError, match=r"page\.odt: it is written as \.html, \.pdf or \.docx"):
        write_iso230(tmp_path / "page.odt", sheet, *test_sheet, remarks=())
    write_iso230(tmp_path / "page.html", sheet, *test_sheet, remarks=())
    with pytest.raises(PageFileError, match="exists already"):
        write_iso230(tmp_path / "page.html", sheet, *test_sheet, remarks=())
    assert iso230_tables(*test_sheet, title="A")[0].title == "A, cycles 1 to 5"


def test_a_rotary_axis_keeps_its_units_everywhere():
    deviations = test_made(X)
    deviations["deviation"].attrs["units"], deviations["position"].attrs["units"] = "arcsec", "deg"
    windows, quoted, part = evaluate_standard(deviations, ROTARY_BUDGET, drift=None)
    dataset = joined(deviations, iso=windows, quoted=quoted)
    part = complete_sheet(part, dataset, campaign=None, environment=None)
    found = Iso230Part.model_validate(plain(part))
    tables = iso230_tables(found, dataset, title="A")
    assert tables[0].columns[1].header == "cycles 1 to 5 / arcsec" and tables[1].columns[1].header == "Position / deg"
    assert iso230_csv(dataset).startswith("target,position_deg,mean_positive_arcsec")
    assert iso230_json(found, dataset)["unit"] == "arcsec"
    page = page_of("A", found, dataset)
    text = " ".join(cell for cells in cells_of(page) for cell in cells)
    assert "deviation / arcsec" in page and "µm" not in text and "ppm" not in text and " mm" not in text


def test_the_budget_of_one_approach_has_its_own_quantities():
    x = X.copy()
    x[:, 0] = np.nan
    found, dataset = evaluated(x)
    budget = describe_iso230(found, dataset)["budget"]
    assert budget.titles[3:] == ("A\u2193 / \u00b5m", "R\u2193 / \u00b5m", "E\u2193 / \u00b5m")
    for column, symbol in enumerate("ARE", start=3):
        shares = [as_number(row.cells[column]) for row in budget.rows[:7]]
        without, whole = (as_number(row.cells[column]) for row in budget.rows[7:])
        assert without == pytest.approx(2 * math.hypot(*shares[:5]), rel=0.06, abs=1e-3)
        assert whole == pytest.approx(2 * math.hypot(*shares), rel=0.06)
        assert whole == pytest.approx(2 * getattr(found.negative, f"{symbol}_um").u, rel=0.06)
    assert iso230_tables(found, dataset, title="A")[2].columns[3].header == "A\u2193 / \u00b5m"


def test_a_test_from_one_side_says_so_and_has_no_empty_rows_or_columns():
    x = X.copy()
    x[:, 1] = np.nan
    part, dataset = evaluated(x)
    told = describe_iso230(part, dataset)
    assert told["missing"] == "Approached from one side only (\u2191). No reading of the window is missing."
    assert [row.cells[0][-2:] for row in told["axis"].rows] == ["A\u2191", "R\u2191", "E\u2191"]
    assert not [row for row in told["positions"].rows if "\u2013" in row.cells]
    x[2, 0, 4] = np.nan
    assert (
        "1 of 35 readings of the window are missing: cycle 3, target 5\u2191"
        in describe_iso230(*evaluated(x))["missing"]
    )


def test_a_value_without_uncertainty_has_no_sign_for_it_and_negative_places_a_minus():
    part, dataset = evaluated(X[:1])
    assert sheet_of("A", part).values.titles[1] == "Value / \u00b5m"
    assert sheet_of("A", evaluated(X)[0]).values.titles[1] == "Value \u00b1 U (k = 2) / \u00b5m"
    moved = dataset.assign_coords(position=dataset["position"] - 20.0)
    assert describe_iso230(part, moved)["positions"].rows[0].cells[1] == "\u221220"


def test_the_scatter_without_drift_stands_beside_two_windows_alone(part):
    readings, _ = simulate(np.random.default_rng(2), kind="warmup", cycles=40)
    dataset = joined(readings, estimate=estimate_drift(readings))
    told = describe_iso230(part, dataset)
    assert told["scatter_um"] == pytest.approx(float(estimate_drift(readings)["scatter"].median()))
    alone = part.model_copy(update={"first": part})
    assert describe_iso230(alone, dataset)["scatter_um"] is None


def test_more_cycles_are_named_where_scatter_is_the_largest_term():
    found = sharpen(evaluated(20.0 * X)[0])
    assert found.contributor == "sampling" and found.cycles == 20 and not found.line
    (part, _) = evaluated(20.0 * X)
    terms = {one.contributor: one.A_um or 0.0 for one in part.contributions}
    halved = {name: u / 2 if name in ("sampling", "extremes") else u for name, u in terms.items()}
    assert found.sharper_um == pytest.approx(2 * math.hypot(*halved.values()), rel=1e-6)
    assert "20 cycles of the axis in the same thermal state would give U(A) of about" in say("sharper", found)


def test_a_coefficient_without_a_value_is_asked_for_in_words(part):
    nameless = part.model_copy(update={"conditions": ()})
    found = sharpen(nameless)
    assert found is not None and found.line == "the expansion coefficient with its uncertainty, 0.3 ppm/K"


@pytest.fixture(scope="module")
def part():
    deviations, _ = simulate(np.random.default_rng(2), kind="warmup", cycles=40)
    drift = estimate_drift(deviations)
    return Iso230Part.model_validate(plain(evaluate_standard(deviations, ASSUMED, drift=drift)[2]))


def test_the_settled_window_stands_with_the_first_one(part):
    told = describe_iso230(part)
    titles = told["axis"].titles
    assert titles[1].startswith(part.window)
    assert titles[2].startswith("First window, cycles 1 to 5")
    assert titles[3].startswith("Range over the windows")
    ranges = [row.cells[3] for row in told["axis"].rows]
    assert " to " in ranges[0] and ranges[1] == ranges[2] == ranges[-1] == "\u2013"
    terms = [row.cells[0] for row in told["axis"].rows]
    assert terms[:3] == [
        "Bidirectional positioning accuracy A",
        "Unidirectional positioning accuracy A\u2191",
        "Unidirectional positioning accuracy A\u2193",
    ]
    assert terms[-1] == "Mean reversal error, with its sign"


def test_results_of_an_older_run_show_their_only_window(part):
    document = {"schema": 2, "campaign": "A", "warnings": [], "iso230": AXIS_VALUES | {"window": "cycles 1 to 5"}}
    told = describe_iso230(Results.model_validate(in_this_schema(document)).iso230)
    assert told["budget"] is None and told["axis"].titles[1].startswith("cycles 1 to 5")
    assert [row.cells[0][-1] for row in told["axis"].rows[:5]] == list("AREMB")


@pytest.fixture(scope="module")
def stated(campaign_folder, tmp_path_factory):
    """The small campaign with everything that the demo states of its test."""
    path = tmp_path_factory.mktemp("stated") / "campaign" / "campaign.toml"
    shutil.copytree(campaign_folder, path.parent)
    further = read_recipe(packaged_recipe("demo")).campaign.further
    return read_test(without(path, "thermography", "plan", "model", "drivers", added=f"\n{further}"), None)


@pytest.mark.chain
def test_the_demo_states_everything_that_a_sheet_asks_for(stated):
    sheet = describe_sheet(stated.title, stated.part, files=stated.files)
    every = dict([*sheet.stated.identity, *sheet.stated.conditions])
    assert len(every) >= 24 and [name for name, text in every.items() if "not stated" in text] == []
    assert every["Instrument 1"].endswith("calibrated 2026-01-15, certificate C-2026-015")
    assert sheet.stated.signatures == [("Measured by", "R. Meyer"), ("Approved by", "S. Lind")]
    assert set(sheet.files) >= {"laser.csv", "environment.csv"} and all(len(sha) == 64 for sha in sheet.files.values())
    decisions = {row.cells[0]: row.cells[2:] for row in sheet.values.rows}
    assert decisions["Bidirectional positioning accuracy A"][0] == "20"
    assert decisions["Reversal error B"] == ["–", "no tolerance stated"]


def test_the_sheet_of_results_holds_the_hash_of_what_was_measured(results_folder):
    test = read_test(results_folder, None)
    origin = json.loads((results_folder / "provenance.json").read_text(encoding="utf-8"))
    laser = origin["parameters"]["interferometry"]["deviations"]
    assert test.files[laser] == origin["inputs"][laser]["sha256"]
    assert test.files["results.json"] == origin["products"]["results.json"]["sha256"]
    assert not [name for name in test.files if name.startswith("thermal")]


@pytest.mark.parametrize(
    "damaged",
    [
        "[]",
        '{"inputs": {"laser.csv": -1}, "parameters": {"interferometry": {"deviations": "laser.csv"}}}',
        '{"parameters": 5}',
    ],
)
def test_damaged_provenance_names_no_measured_file(damaged, tmp_path):
    (tmp_path / "provenance.json").write_text(damaged)
    assert files_of_run(tmp_path) == {}


@pytest.mark.chain
def test_a_sheet_is_that_of_the_laboratory_and_in_its_language(stated, tmp_path):
    Image.new("RGB", (60, 20), "navy").save(tmp_path / "logo.png")
    (tmp_path / "lab.html").write_text(
        "<style>b{color:navy}</style><b>Above</b>{{ sheet }}<i>Below</i>", encoding="utf-8"
    )
    template = docx.Document()
    template.sections[0].footer.paragraphs[0].text = "Our footer"
    template.save(str(tmp_path / "lab.docx"))
    own = Letterhead(
        head="Messlabor; Stadt", logo=str(tmp_path / "logo.png"), word_template=str(tmp_path / "lab.docx"),
        page_template=str(tmp_path / "lab.html"), language="de",
    )  # fmt: skip
    plain, sheet = (
        describe_sheet(stated.title, stated.part, files=stated.files, own=one) for one in (Letterhead(), own)
    )
    # Every sentence of the program is in the catalogue; what somebody stated stays as it is, and so do days.
    pairs = zip(
        (*plain.stated.identity, *plain.stated.conditions),
        (*sheet.stated.identity, *sheet.stated.conditions),
        strict=True,
    )
    assert [name for (name, _), (other, _) in pairs if name == other] == []
    sentences = [*plain.notes, *(cell for row in plain.requirements.rows for cell in row.cells), plain.standard]
    others = [*sheet.notes, *(cell for row in sheet.requirements.rows for cell in row.cells), sheet.standard]
    assert [text for text, other in zip(sentences, others, strict=True) if text == other] == []
    told = dict((*sheet.stated.identity, *sheet.stated.conditions))
    assert told["Steuerung"] == "LinuxCNC 2.9" and "2026-03-09" in told["Datum der Prüfung"]
    rows = [row.cells[0] for row in sheet.values.rows]
    assert "Umkehrspanne B" in rows and all("." not in row.cells[1] for row in sheet.values.rows)
    write_iso230(tmp_path / "sheet.html", sheet, stated.part, stated.dataset, remarks=())
    page = (tmp_path / "sheet.html").read_text(encoding="utf-8")
    assert page.index("<b>Above</b>") < page.index("Messlabor<br>Stadt") < page.index("<i>Below</i>")
    assert 'lang="de"' in page and "Datum, Unterschrift" in page and "data:image/png;base64," in page
    write_iso230(tmp_path / "sheet.docx", sheet, stated.part, stated.dataset, remarks=())
    (section,) = docx.Document(str(tmp_path / "sheet.docx")).sections
    assert section.footer.paragraphs[0].text == "Our footer"
    assert [one.text for one in section.header.paragraphs][-2:] == ["Messlabor", "Stadt"]
    (tmp_path / "lab.html").write_text("no place", encoding="utf-8")
    with pytest.raises(TemplateError, match=r"write \{\{ sheet \}\} where the sheet is to stand"):
        render_iso230(sheet, stated.part, stated.dataset, remarks=())


@pytest.mark.parametrize(
    ("english", "german"),
    [
        ("18.1 ± 6.7", "18,1 ± 6,7"),
        ("Not decided: A ≤ 7.5 µm. Pass: R ≤ 6 µm. 10 of 12 windows differ.",
         "Nicht entschieden: A ≤ 7,5 µm. Bestanden: R ≤ 6 µm. 10 von 12 Fenstern weichen ab."),
        ("More than 99 % of the drift follows the expansion of the axis and a sudden step together.",
         "Mehr als 99 % der Drift folgen zusammen der Ausdehnung der Achse und einem plötzlichen Sprung."),
        ("A sentence that nobody translated, of 1.5 µm.", "A sentence that nobody translated, of 1.5 µm."),
        ("LinuxCNC 2.9", "LinuxCNC 2.9"),
    ],
)  # fmt: skip
def test_sentences_are_translated_with_what_stands_in_their_gaps(english, german):
    assert translation("de")(english) == german
    assert translation("en")(english) == english


@pytest.mark.chain
@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed (Debian: apt-get install chromium)")
def test_the_sheet_is_one_page_of_a4(stated, tmp_path):
    sheet = describe_sheet(stated.title, stated.part, files=stated.files)
    write_iso230(tmp_path / "sheet.html", sheet, stated.part, stated.dataset, remarks=())
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 688, "height": 998}, bypass_csp=True)
        page.goto((tmp_path / "sheet.html").as_uri() + "#on-a4")
        page.wait_for_function("document.documentElement.dataset.paper == 'ready'")
        page.emulate_media(media="print")
        bottom = page.evaluate("document.querySelector('#sheet .hashes').getBoundingClientRect().bottom + scrollY")
        browser.close()
    # The text of A4 with margins of 17 mm and 16 mm: 264 mm of 96 px to the inch.
    assert 700 < bottom < 264 / 25.4 * 96
