"""Names that columns, fiducials, files, folders and tests may have: each arrives as it is wherever it is shown, and two stay two.

None reaches a page as markup or a script, a folder as a path, or the network.
"""

from __future__ import annotations

import asyncio
import csv
import json
import shutil
import socket
from collections.abc import Iterator, Sequence
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path
from typing import Any, NoReturn
from unicodedata import normalize

import docx
import numpy as np
import openpyxl
import pytest
from typer.testing import CliRunner

from fusion import cli
from fusion.app.parts import State
from fusion.app.results import Products, results_screen
from fusion.app.setup.screen import SetUpScreen
from fusion.campaign.config import load_campaign
from fusion.pipeline.fleet import find_members
from fusion.report.exports.controls import emit
from fusion.report.fleet import Row, as_csv, render_fleet, with_findings, write_book
from fusion.results.recursion import read_recursion
from fusion.results.store import read_product
from tests.fusion.app.texts import texts
from tests.fusion.campaign_parts import change, simulated
from tests.fusion.conftest import search_few

pytestmark = pytest.mark.chain

NFD = normalize("NFD", "Größe")
SCRIPT = "<script>window.harmed=1</script><img src=x onerror=harm()>"
TITLE = " =1+1 ../../<mark>A/B</mark> {{7*7}} [red]x[/red] 'q' \"q\" \\ 🌡 %41 @name $$x$$ :smile: "
CHANNELS = (
    "Disp. X", "101", "items", "X", "X, predicted", "_y $\\frac$ a/b", "<mark>{{7*7}}</mark>" + "L" * 300, "mean",
)  # fmt: skip
SENSORS = (
    "time",
    "1",
    "=HYPERLINK('http://example.com')",
    "@x $y {0} [red]t[/red] %41 #",
    "Größe",
    NFD,
    "index",
    SCRIPT,
)
DRIVERS = ("a b", "a_b", "'q' \"q\" back\\slash 🌡 :smile: 100 %", "values", "D / 1")
#: What an axis is given: fiducials, and drivers beside those of the record.
FIDUCIALS = ("a.b", "1", "<mark>F", "{{7*7}}", "=1+1", "@name", "#", "[red]", "Größe", NFD, "items", "L" * 300)


class Page(HTMLParser):
    """The text of a page without its scripts, and the names of its elements."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.told: list[str] = []
        self.elements: set[str] = set()
        self.scripts = 0
        self.handlers: list[str] = []
        self.addresses: list[str] = []
        self.feed(page)

    @classmethod
    def of(cls, path: Path) -> Page:
        return cls(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.add(tag)
        held = dict(attrs)
        self.scripts += tag == "script" and held.get("type") != "application/json"
        self.handlers += [name for name in held if name.startswith("on")]
        self.addresses += [str(held[name]) for name in ("src", "href", "action") if held.get(name)]

    def handle_data(self, data: str) -> None:
        if self.lasttag not in ("script", "style"):
            self.told.append(data)

    @property
    def text(self) -> str:
        return "\n".join(self.told)


def run(*arguments: str | Path) -> str:
    ended = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
    assert ended.exit_code == 0, ended.output
    return ended.output


def no_network(*arguments: object, **options: object) -> NoReturn:
    raise AssertionError("the program asked the network")


def strict(path: Path) -> Any:
    """JSON without the words that JSON does not have."""

    def refuse(word: str) -> NoReturn:
        raise AssertionError(f"{path.name} holds {word}")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def missing(names: Sequence[str], text: str) -> list[str]:
    return [name for name in names if name not in text]


def headings(path: Path) -> list[str]:
    return next(csv.reader(StringIO(path.read_text(encoding="utf-8"))))


def as_text(name: str) -> str:
    """A name as a spreadsheet gets it."""
    return f"'{name}" if name.startswith(("=", "@")) else name


def cells(path: Path) -> Iterator[openpyxl.cell.Cell]:
    for sheet in openpyxl.load_workbook(path):
        for row in sheet.iter_rows():
            yield from row


def words_of(path: Path) -> str:
    """All texts of a document of Word."""
    document = docx.Document(str(path))
    in_tables = (cell.text for table in document.tables for row in table.rows for cell in row.cells)
    return "\n".join([*(paragraph.text for paragraph in document.paragraphs), *in_tables])


# A record whose columns are called so.


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of seven hours with a step that is found, without a network; nothing is written outside them."""
    base = tmp_path_factory.mktemp("names") / f"Prüfstand 测试 {'x' * 170}"
    folder = base / f"=1+1 #%41 {{0}} [1] <b>' {NFD}"
    folder.mkdir(parents=True)
    rng, seconds = np.random.default_rng(1), 60.0 * np.arange(400)
    courses = [1.0 - np.exp(-seconds / (1800.0 * (1 + k))) for k in range(len(SENSORS))]
    courses[0] += 0.4 * np.sin(seconds / 700.0)
    step = seconds > 11_000.0
    columns = {
        **{f"{name} [degC]": 20.0 + 5.0 * course for name, course in zip(SENSORS, courses, strict=True)},
        **{f"{name} [um]": (4.0 + k) * courses[0] + (2.0 + k) * step for k, name in enumerate(CHANNELS)},
    }
    noisy = {name: np.round(values + rng.normal(0.0, 0.05, seconds.size), 3) for name, values in columns.items()}
    drivers = {f"{name} [1/min]": np.arange(seconds.size) // (40 + 10 * k) % 2 for k, name in enumerate(DRIVERS)}
    table = {"time [s]": seconds, **noisy, **drivers}
    with (folder / "rec [1] #.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([list(table), *zip(*(values.tolist() for values in table.values()), strict=True)])
    units = {"temperatures": "degC", "displacements": "um", "drivers": "1/min"}
    used = {
        key: [f"{name} [{unit}]" for name in names]
        for (key, unit), names in zip(units.items(), (SENSORS, CHANNELS, DRIVERS), strict=True)
    }
    lines = [f"{key} = {json.dumps(names, ensure_ascii=False)}" for key, names in used.items()]
    stated = ['file = "rec [1] #.csv"', 'time = "time [s]"', 'start = "2026-03-09T06:30:00Z"', *lines]
    title = f"title = {json.dumps(TITLE, ensure_ascii=False)}"
    text = "\n".join(["[campaign]", title, "[record]", *stated])
    (folder / "campaign.toml").write_text(f"{text}\n", encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket.socket, "connect", no_network)
        patch.setattr(socket, "getaddrinfo", no_network)
        search_few(patch, "step_event")
        run("run", folder / "campaign.toml")
    assert [path.name for path in base.iterdir()] == [folder.name]
    return folder / "results"


def test_a_report_of_a_record_holds_every_name_as_text(record: Path) -> None:
    results = json.loads((record / "results.json").read_text(encoding="utf-8"))
    assert results["campaign"] == TITLE and tuple(results["loop"]["channels"]) == CHANNELS
    assert results["loop"]["steps"], "without an effect there is no column for it"
    page = Page.of(record / "report.html")
    assert not missing([*CHANNELS, *SENSORS, *DRIVERS, TITLE.strip()], page.text)
    assert "mark" not in page.elements
    # BokehJS, the script that draws the charts, and that of the page.
    assert page.scripts <= 3 and page.handlers == []
    assert all(address.startswith(("#", "data:")) for address in page.addresses), page.addresses


def test_products_are_strict_json_and_lie_where_they_belong(record: Path) -> None:
    for name in ("results.json", "provenance.json", "manifest.json", ".stages/stamps.json"):
        strict(record / name)
    assert strict(record / "results.json")["campaign"] == TITLE
    written = {"fusion.nc", "results.json", "provenance.json", "report.html", "manifest.json", ".stages"}
    assert {path.name for path in record.iterdir()} == written
    assert {path.name for path in record.parent.iterdir()} == {"campaign.toml", "rec [1] #.csv", "results"}


@pytest.mark.browser
@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium")
def test_a_browser_runs_no_script_of_a_file_and_loads_nothing(record: Path, tmp_path: Path) -> None:
    """Even what a template forgot to escape is not run: the policy of the page names its own scripts by their hashes."""
    from playwright.sync_api import sync_playwright

    page = (record / "report.html").read_text(encoding="utf-8")
    forgotten = "<script>window.harmed=1</script><img src='http://localhost/x.png' onerror='window.harmed=1'></main>"
    (tmp_path / "forgotten.html").write_text(page.replace("</main>", forgotten), encoding="utf-8")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        tab = browser.new_page()
        told: list[str] = []
        tab.on("console", lambda message: told.append(message.text) if message.type == "error" else None)
        tab.on("pageerror", lambda error: told.append(str(error)))
        tab.goto((tmp_path / "forgotten.html").as_uri())
        tab.wait_for_selector("html[data-charts=drawn]")
        assert tab.evaluate("window.harmed") is None
        # The script, the picture and what is called when it fails; nothing of the page itself.
        assert len(told) == 3 and all("Content Security Policy" in text for text in told), told
        browser.close()


def test_sheets_by_iso_230_3_hold_every_name_as_text(record: Path, tmp_path: Path) -> None:
    for name in ("sheet.html", "sheet.docx"):
        run("iso230-3", record, "--out", tmp_path / name)
    text = words_of(tmp_path / "sheet.docx")
    assert not missing([*CHANNELS, TITLE.strip()], text)
    assert not missing([*CHANNELS, TITLE.strip()], Page.of(tmp_path / "sheet.html").text)


def test_exports_of_a_record_hold_every_name_once_and_no_formula(record: Path, tmp_path: Path) -> None:
    for format in ("csv", "xlsx", "model-json"):
        run("export", record, "--format", format, "--out", tmp_path / format, "--force")
    of_readings = headings(tmp_path / "csv" / "readings.csv")
    assert len(set(of_readings)) == len(of_readings) == 3 + 2 * len(CHANNELS) + len(SENSORS) + len(DRIVERS)
    assert not missing([as_text(f"{name} [degC]") for name in SENSORS], "\n".join(of_readings))
    for path in (tmp_path / "csv").iterdir():
        rows = csv.reader(StringIO(path.read_text(encoding="utf-8")))
        assert not [text for row in rows for text in row if text.startswith(("=", "@", "+"))], path.name
    every = list(cells(tmp_path / "xlsx" / "results.xlsx"))
    assert not [cell for cell in every if cell.data_type == "f"]
    shown = "\n".join(str(cell.value) for cell in every)
    assert not missing([*CHANNELS, *SENSORS, *DRIVERS, TITLE.strip()], shown)
    model = read_recursion(tmp_path / "model-json" / "model.json")
    assert {one.name for one in model.outputs} <= set(CHANNELS)
    assert {one.name for one in model.inputs} <= {*SENSORS, *DRIVERS}
    for format in ("model-c", "model-st", "model-linuxcnc"):
        _, text = emit(model, format)
        if format == "model-linuxcnc":
            compile(text, "hal", "exec")


def test_the_screens_of_a_record_hold_every_name_and_write_them_again(record: Path, tmp_path: Path) -> None:
    state = State(root=record.parent, results=record)
    assert TITLE.strip() in texts([results_screen(state)])
    shutil.copy(record.parent / "rec [1] #.csv", tmp_path)
    screen = SetUpScreen(State(root=tmp_path))
    asyncio.run(screen.look())
    assert screen.editor is not None
    asyncio.run(screen.editor._on_save(None))
    stated = load_campaign(tmp_path / "campaign.toml").record
    assert stated is not None
    assert set(stated.columns) >= {f"{name} [um]" for name in CHANNELS}


# An axis with a camera, whose files, fiducials and drivers are called so.

RECIPE = """\
[campaign]
title = "names"
axis = "X"
seed = 11
[test]
cycles = 12
targets = 6
spacing_mm = 40
[camera]
columns = 320
rows = 240
focal_px = 765
"""
FILES = {
    "thermal": "IR [1] {0}",
    "laser.csv": normalize("NFD", "Läser 'q' %41.csv"),
    "environment.csv": "env;x&y.csv",
    "drivers.csv": "=drivers #1.csv",
    "fiducials.csv": "<mark>fid [1].csv",
}


@pytest.fixture(scope="module")
def axis(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of an axis; the campaign file names its files in the composed form, in which one of them does not lie there."""
    base = tmp_path_factory.mktemp("axis")
    folder = base / "=fleet" / f"#%41 {{0}} [red] <b>' {NFD}"
    folder.parent.mkdir()
    simulated(base, RECIPE).parent.rename(folder)
    rows = list(csv.reader(StringIO((folder / "fiducials.csv").read_text())))
    named = [[name, *row[1:]] for name, row in zip(FIDUCIALS, rows[1:], strict=True)]
    with (folder / "fiducials.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([rows[0], *named])
    added = [name for name in (*FIDUCIALS, *DRIVERS) if "/" not in name]
    lines = list(csv.reader(StringIO((folder / "drivers.csv").read_text())))
    rng = np.random.default_rng(2)
    with (folder / "drivers.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerow([*lines[0], *(f"{name} [1]" for name in added)])
        csv.writer(file).writerows([*row, *np.round(rng.random(len(added)), 3)] for row in lines[1:])
    campaign = change(folder / "campaign.toml", '"names"', json.dumps(TITLE, ensure_ascii=False))
    for old, new in FILES.items():
        (folder / old).rename(folder / new)
        change(campaign, f'"{old}', f'"{normalize("NFC", new)}')
    with pytest.MonkeyPatch.context() as patch:
        search_few(patch, "axis_expansion", "table_offset", "reversal_drift")
        run("run", campaign)
    return folder / "results"


def test_a_report_of_an_axis_holds_every_name_as_text(axis: Path) -> None:
    results = json.loads((axis / "results.json").read_text(encoding="utf-8"))
    assert results["campaign"] == TITLE
    assert tuple(results["registration"]["leave_one_out_mm"]) == FIDUCIALS
    page = Page.of(axis / "report.html")
    assert "mark" not in page.elements
    assert not missing([*FIDUCIALS, TITLE.strip(), *(name for name in FILES.values() if "." in name)], page.text)


def test_drivers_of_an_axis_keep_their_names_in_the_product(axis: Path) -> None:
    fused = read_product(axis, "fusion")
    assert not missing([name for name in (*FIDUCIALS, *DRIVERS) if "/" not in name], "\n".join(map(str, fused)))


def test_sheet_exports_fleet_and_comparison_of_an_axis(axis: Path, tmp_path: Path) -> None:
    for name in ("sheet.html", "sheet.docx"):
        run("iso230", axis, "--out", tmp_path / name)
    assert TITLE.strip() in words_of(tmp_path / "sheet.docx")
    assert TITLE.strip() in Page.of(tmp_path / "sheet.html").text
    for format in ("csv", "xlsx", "linuxcnc", "siemens840d", "heidenhain"):
        run("export", axis, "--format", format, "--out", tmp_path / format, "--force", "--spacing", "40 mm")
    assert not [cell for cell in cells(tmp_path / "xlsx" / "results.xlsx") if cell.data_type == "f"]
    other = shutil.copytree(axis, tmp_path / "other")
    run("compare", axis, other, "--out", tmp_path / "compared.html")
    assert TITLE.strip() in Page.of(tmp_path / "compared.html").text
    (member,) = find_members([axis.parent.parent])
    row = with_findings(Row(f"=1/{member.name}", state="finished"), axis)
    (line,) = csv.DictReader(StringIO(as_csv([row])))
    assert (line["name"], line["title"]) == (f"'{row.name}", TITLE)
    page = Page(render_fleet([row], started="2026-03-09T06:30:00+00:00"))
    assert not missing([row.name, TITLE.strip()], page.text) and "mark" not in page.elements
    write_book(tmp_path / "fleet.xlsx", [row])
    assert not [cell for cell in cells(tmp_path / "fleet.xlsx") if cell.data_type == "f"]


def test_the_screens_of_an_axis_hold_its_title(axis: Path) -> None:
    products = Products(axis)
    assert TITLE.strip() in texts([results_screen(State(root=axis.parent, results=axis))])
    assert products.layers
