"""The page of a test: every number equals plain arithmetic on the readings, names are escaped, nothing is replaced."""

from __future__ import annotations

import csv
import io
import math
import re
import statistics
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.campaign.iso_budget import StatedBudget
from fusion.pipeline.iso230.evaluation import evaluate_standard
from fusion.pipeline.iso230.sheet import complete_sheet
from fusion.products.grouped import joined
from fusion.products.results_axis import Iso230Part
from fusion.products.store import plain
from fusion.report.iso230_page import (
    Iso230PageError,
    iso230_csv,
    iso230_json,
    iso230_tables,
    render_iso230,
    write_iso230,
)
from fusion.report.iso230_section import describe_iso230
from interferometry.iso230.budget import SCATTER_ALONE
from tests.fusion.pipeline.iso230.test_evaluation import ASSUMED
from tests.interferometry.iso230.made_tests import test_made

X = np.random.default_rng(21).normal(0, 0.6, (5, 2, 7)) + np.array([[1.1], [-0.4]]) + 1.7 * np.arange(7.0)
VERSIONS = {"thermofuse": "0"}


@pytest.fixture(scope="module")
def test_sheet() -> tuple[Iso230Part, xr.Dataset]:
    deviations = test_made(X)
    windows, settled, part = evaluate_standard(deviations, ASSUMED, drift=None, material_degC=None)
    dataset = joined(deviations, iso=windows, settled=settled)
    sheet = complete_sheet(part, dataset, campaign=None, environment=None)
    return Iso230Part.model_validate(plain(sheet)), dataset


def cells_of(page: str) -> list[list[str]]:
    """Texts of the cells of every row of every table of a page."""
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", page, re.DOTALL)
    return [
        [re.sub(r"<[^>]+>", "", cell).strip() for cell in re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row, re.DOTALL)]
        for row in rows
    ]


def as_number(text: str) -> float:
    return float(text.replace("\u2212", "-"))


def by_definition() -> dict[str, float]:
    """The quantities of the axis, one reading after the other."""
    mean = [[statistics.fmean(X[:, d, i]) for i in range(7)] for d in range(2)]
    s = [[statistics.stdev(X[:, d, i]) for i in range(7)] for d in range(2)]
    cells = [(mean[d][i], s[d][i]) for d in range(2) for i in range(7)]
    reversal = [mean[0][i] - mean[1][i] for i in range(7)]
    both = [(mean[0][i] + mean[1][i]) / 2 for i in range(7)]
    wide = [max(2 * s[0][i] + 2 * s[1][i] + abs(reversal[i]), 4 * s[0][i], 4 * s[1][i]) for i in range(7)]
    one_way = {}
    for d, arrow in enumerate("\u2191\u2193"):
        pairs = list(zip(mean[d], s[d], strict=True))
        one_way[f"A{arrow}"] = max(m + 2 * q for m, q in pairs) - min(m - 2 * q for m, q in pairs)
        one_way[f"R{arrow}"] = 4 * max(s[d])
        one_way[f"E{arrow}"] = max(mean[d]) - min(mean[d])
    return {
        "A": max(m + 2 * q for m, q in cells) - min(m - 2 * q for m, q in cells),
        "R": max(wide),
        "E": max(m for m, _ in cells) - min(m for m, _ in cells),
        "M": max(both) - min(both),
        "B": max(abs(b) for b in reversal),
        "sign": statistics.fmean(reversal),
        **one_way,
    }


def test_the_values_of_the_axis_are_those_of_the_definitions(test_sheet: tuple[Iso230Part, xr.Dataset]) -> None:
    page = render_iso230("A", *test_sheet, remarks=(), versions=VERSIONS)
    true, seen = by_definition(), 0
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
    assert seen == len(true) == 12


def test_the_values_of_the_targets_are_those_of_the_readings(test_sheet: tuple[Iso230Part, xr.Dataset]) -> None:
    page = render_iso230("A", *test_sheet, remarks=(), versions=VERSIONS)
    rows = [cells for cells in cells_of(page) if len(cells) == 12 and cells[0].isdigit()]
    assert len(rows) == 7
    for i, cells in enumerate(rows):
        up, down = ([float(v) for v in X[:, d, i]] for d in range(2))
        m_up, m_down, s_up, s_down = (
            statistics.fmean(up),
            statistics.fmean(down),
            statistics.stdev(up),
            statistics.stdev(down),
        )
        reversal = m_up - m_down
        r_i = max(2 * s_up + 2 * s_down + abs(reversal), 4 * s_up, 4 * s_down)
        true = [m_up, m_down, s_up, s_down, 4 * s_up, 4 * s_down, (m_up + m_down) / 2, reversal, r_i]
        assert [as_number(cell) for cell in cells[:2]] == [i + 1, 10.0 * i]
        assert [as_number(cell) for cell in cells[2:11]] == pytest.approx(true, abs=0.00501)
        assert cells[11] == "5, 5"


def test_the_sums_of_the_budget_are_those_of_its_rows(test_sheet: tuple[Iso230Part, xr.Dataset]) -> None:
    rows = describe_iso230(*test_sheet)["budget"].rows
    for column in range(3, 9):
        contributions = [as_number(row.cells[column]) for row in rows[:5] if row.cells[column] != "\u2013"]
        sampling = [as_number(row.cells[column]) for row in rows[5:7]]
        without, whole = (as_number(row.cells[column]) for row in rows[7:])
        # Two significant digits are printed: 5 % of the smallest.
        assert without == pytest.approx(2 * math.hypot(*contributions), rel=0.06, abs=1e-3)
        assert whole == pytest.approx(2 * math.hypot(*contributions, *sampling), rel=0.06)


def test_json_and_csv_hold_full_precision(test_sheet: tuple[Iso230Part, xr.Dataset]) -> None:
    told = iso230_json(*test_sheet)
    assert told["settled"]["A_um"]["value"] == pytest.approx(by_definition()["A"], rel=1e-12)
    rows = list(csv.DictReader(io.StringIO(iso230_csv(*test_sheet))))
    assert [float(row["mean_positive_um"]) for row in rows] == pytest.approx(X[:, 0].mean(axis=0))
    assert [float(row["B_i_um"]) for row in rows] == pytest.approx(X[:, 0].mean(axis=0) - X[:, 1].mean(axis=0))
    assert told["targets"][0]["readings_negative"] == 5


def test_missing_readings_are_named_under_the_table() -> None:
    x = X.copy()
    x[3, 1, 2] = np.nan
    deviations = test_made(x)
    windows, settled, part = evaluate_standard(deviations, ASSUMED, drift=None, material_degC=None)
    dataset = joined(deviations, iso=windows, settled=settled)
    page = render_iso230("A", Iso230Part.model_validate(plain(part)), dataset, remarks=(), versions=VERSIONS)
    assert "1 of 70 readings of the window are missing: cycle 4, target 3\u2193 (missing)." in page


def test_a_single_run_shows_deviations_and_says_what_is_not_possible() -> None:
    dataset = test_made(X[:1])
    page = render_iso230("A", None, dataset, remarks=("1 line left out",), versions=VERSIONS)
    assert "a standard deviation s is not possible" in page and "<li>1 line left out</li>" in page
    rows = [cells for cells in cells_of(page) if cells and cells[0].isdigit()]
    assert [as_number(cells[3]) for cells in rows] == pytest.approx(X[0, 1], abs=0.0051)
    assert list(csv.DictReader(io.StringIO(iso230_csv(None, dataset))))[6]["deviation_positive_um"] == str(X[0, 0, 6])
    assert len(iso230_tables(None, dataset, title="A")) == 1


def test_names_from_files_are_escaped_and_no_file_is_replaced(
    test_sheet: tuple[Iso230Part, xr.Dataset], tmp_path: Path
) -> None:
    page = render_iso230("<i>A</i>", *test_sheet, remarks=("<script>",), versions=VERSIONS)
    assert "<i>A</i>" not in page and "<li>&lt;script&gt;</li>" in page
    with pytest.raises(Iso230PageError, match=r"page\.docx: the sheet is written as \.html or \.pdf"):
        write_iso230(tmp_path / "page.docx", page)
    write_iso230(tmp_path / "page.html", page)
    with pytest.raises(Iso230PageError, match="exists already"):
        write_iso230(tmp_path / "page.html", page)
    assert iso230_tables(*test_sheet, title="A")[0].title == "A, cycles 1 to 5"


def test_a_rotary_axis_has_tables_and_csv_alone() -> None:
    deviations = test_made(X)
    deviations["deviation"].attrs["units"], deviations["position"].attrs["units"] = "arcsec", "deg"
    budget = StatedBudget(SCATTER_ALONE, dict.fromkeys(ASSUMED.origins, "not of a rotary axis"))
    windows, settled, part = evaluate_standard(deviations, budget, drift=None, material_degC=None)
    dataset = joined(deviations, iso=windows, settled=settled)
    found = Iso230Part.model_validate(plain(part))
    tables = iso230_tables(found, dataset, title="A")
    assert tables[0].columns[1].header == "cycles 1 to 5 / arcsec" and tables[1].columns[1].header == "Position / deg"
    assert iso230_csv(found, dataset).startswith("target,position_deg,mean_positive_arcsec")
    for write in (
        lambda: iso230_json(found, dataset),
        lambda: render_iso230("A", found, dataset, remarks=(), versions=VERSIONS),
    ):
        with pytest.raises(Iso230PageError, match="a rotary one"):
            write()


def test_the_budget_of_one_approach_has_its_own_quantities() -> None:
    x = X.copy()
    x[:, 0] = np.nan
    deviations = test_made(x)
    windows, settled, part = evaluate_standard(deviations, ASSUMED, drift=None, material_degC=None)
    found = Iso230Part.model_validate(plain(part))
    dataset = joined(deviations, iso=windows, settled=settled)
    budget = describe_iso230(found, dataset)["budget"]
    assert [column.title for column in budget.columns[3:]] == [
        "A\u2193 / \u00b5m",
        "R\u2193 / \u00b5m",
        "E\u2193 / \u00b5m",
    ]
    assert found.settled is not None
    for column, symbol in enumerate("ARE", start=3):
        shares = [as_number(row.cells[column]) for row in budget.rows[:7]]
        without, whole = (as_number(row.cells[column]) for row in budget.rows[7:])
        assert without == pytest.approx(2 * math.hypot(*shares[:5]), rel=0.06, abs=1e-3)
        assert whole == pytest.approx(2 * math.hypot(*shares), rel=0.06)
        assert whole == pytest.approx(2 * getattr(found.settled.negative, f"{symbol}_um").u, rel=0.06)
    assert iso230_tables(found, dataset, title="A")[2].columns[3].header == "A\u2193 / \u00b5m"
