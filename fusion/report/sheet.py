"""Sheets of tests by ISO 230-2 and ISO 230-3, a page to be signed and what it rests on: HTML, PDF, Word, and values for programs."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import rich.table
import xarray as xr

from fusion.common import versions
from fusion.report.campaign import DRAWN, describe_iso230, describe_thermal_tests, values_to_sign, verification_table
from fusion.report.charts.model import draw_thermal_tests
from fusion.report.charts.readings import has_windows, plot_test, plot_windows
from fusion.report.charts.style import Chart, embed, of_rank
from fusion.report.letterhead import PLAIN, Letterhead, Translate, translated, translation
from fusion.report.page import page_format, render_page, write_page
from fusion.report.wording import Table, Words, print_table, sentences, table
from fusion.results.axis import Iso230Part
from fusion.results.parts import Iso230Condition, ThermalTest
from fusion.results.store import group, write_atomically
from interferometry.plots import new_axes, plot_iso230
from thermography.common import ACTING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fusion.analysis.drift_model.verification import ChannelVerdict

#: Endings of the files that a sheet is written to.
SHEET_FORMATS = (".html", ".pdf", ".docx")
#: The last condition that says whose test of which axis a sheet is of; the others follow the values.
_LAST = "sign_convention"
#: Conditions that stand where somebody signs; who approves stands only there.
_SIGNED = {"Measured by": "operator", "Approved by": "approved_by"}
#: What the standard means by a deviation, where a laboratory states no convention.
_CONVENTION = "not stated; taken as actual minus target position (ISO 230-2)"
#: Dashes of lines as matplotlib names them.
_LINES = {"solid": "-", "dashed": "--", "dotdash": "-.", "dotted": ":"}
#: Characters of a name beside a curve; a longer one would leave no room for the curves.
_LONGEST_LABEL = 40
_MET = {True: "yes", False: "no", None: "not known"}


@dataclass(frozen=True)
class Stated:
    """What is stated of a test, as pairs of name and text: whose it was, its conditions, and who signs."""

    identity: list[tuple[str, str]]
    conditions: list[tuple[str, str]]
    signatures: list[tuple[str, str]]

    @classmethod
    def of(cls, rows: Sequence[Iso230Condition], convention: str) -> Stated:
        """Sort the conditions of a test; `convention` stands where no sign convention is stated."""
        texts = {row.key: row.text for row in rows}
        shown = [row for row in rows if row.key != "approved_by"]
        told = [(row.name, row.text or (convention if row.key == _LAST else "not stated")) for row in shown]
        count = next((k for k, row in enumerate(shown, start=1) if row.key == _LAST), len(shown))
        return cls(told[:count], told[count:], [(role, texts.get(key, "")) for role, key in _SIGNED.items()])


@dataclass(frozen=True)
class Sheet:
    """What a sheet shows, in words; `values` under their caption, before the `notes` on what they mean; `requirements` without rows where
    there are none, SHA-256 of files by name.
    """

    title: str
    standard: str
    stated: Stated
    caption: str
    values: Table
    files: Mapping[str, str]
    own: Letterhead = PLAIN
    notes: Sequence[str] = ()
    requirements: Table = field(default_factory=lambda: table((), ()))
    version: str = field(default_factory=lambda: versions()["thermofuse"])

    @property
    def tell(self) -> Translate:
        """What translates the words around it."""
        return translation(self.own.language)

    def in_its_language(self) -> Sheet:
        """Return it in the language that is asked for; title, names and hashes stay as they are."""
        tell = self.tell

        def pairs(rows: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
            return [(tell(name), tell(text)) for name, text in rows]

        stated = Stated(
            pairs(self.stated.identity),
            pairs(self.stated.conditions),
            [(tell(role), name) for role, name in self.stated.signatures],
        )
        return replace(
            self,
            standard=tell(self.standard),
            stated=stated,
            caption=tell(self.caption),
            values=translated(self.values, tell),
            notes=[*map(tell, self.notes)],
            requirements=translated(self.requirements, tell),
        )


def describe_sheet(title: str, part: Iso230Part, *, files: Mapping[str, str], own: Letterhead = PLAIN) -> Sheet:
    """Return what the sheet of a test by ISO 230-2 shows."""
    requirements = [[check.name, _MET[check.met], check.evidence] for check in part.checks]
    shown = Sheet(
        title=title,
        standard="Accuracy and repeatability of positioning by ISO 230-2:2014",
        stated=Stated.of(part.conditions, _CONVENTION),
        caption=f"Values of {part.window}",
        values=values_to_sign(part),
        notes=sentences("decided_how", part),
        requirements=table([Words("Requirement of ISO 230-2"), Words("Met"), Words("Found")], requirements),
        files=files,
        own=own,
    )
    return shown.in_its_language()


def describe_thermal_sheet(
    title: str, test: ThermalTest, *, files: Mapping[str, str], own: Letterhead = PLAIN
) -> Sheet:
    """Return what the sheet of a test by ISO 230-3 shows."""
    (described,) = describe_thermal_tests([test])
    shown = Sheet(
        title=title,
        standard=f"Thermal effects by ISO 230-3:2020. {described['title']}",
        stated=Stated.of(test.conditions, "not stated"),
        caption="Largest less smallest value, with expanded uncertainty (k = 2)",
        values=described["distortions"],
        files=files,
        own=own,
    )
    return shown.in_its_language()


def write_verification(
    path: Path,
    title: str,
    verdicts: Sequence[ChannelVerdict],
    remarks: Sequence[str],
    conditions: Sequence[Iso230Condition],
    files: Mapping[str, str],
    own: Letterhead,
) -> None:
    """Write the sheet of a test after a compensation, as found, predicted and achieved; nothing is replaced."""
    shown = Sheet(
        title=title,
        standard="Drift without compensation, as predicted and as achieved with it",
        stated=Stated.of(conditions, "not stated"),
        caption="Range of the drift; predicted with 95 % interval",
        values=verification_table(verdicts),
        notes=[*(f"{one.name}: {one.fault}: {one.reason}" for one in verdicts if one.fault), *remarks],
        files=files,
        own=own,
    ).in_its_language()
    _write(path, lambda: [(shown, None)], lambda: render_page("verification.html.j2", {}, sheet=shown))


def _write(path: Path, for_word: Callable[[], Sequence[tuple[Sheet, Axes | None]]], page: Callable[[], str]) -> None:
    """Write sheets, each with its chart, in the format of the file's name; nothing is replaced."""
    if page_format(path, *SHEET_FORMATS) == ".docx":
        drawn = for_word()
        write_atomically(path, lambda temporary: _write_word(temporary, drawn))
    else:
        write_page(path, page())


def draw_iso230(dataset: xr.Dataset) -> dict[str, Chart]:
    """Return the charts of the section on ISO 230-2, by name."""
    charts = {"iso230": plot_test(group(dataset, "quoted"), dataset["position"])}
    windows = group(dataset, "iso")
    return {**charts, "windows": plot_windows(windows)} if has_windows(windows) else charts


def render_iso230(sheet: Sheet, part: Iso230Part, dataset: xr.Dataset, *, remarks: tuple[str, ...]) -> str:
    """Return the page of a test as HTML text: the sheet, then what it rests on."""
    summary = {"iso230": describe_iso230(part, dataset), "assumptions": {"iso230": ""}}
    charts = draw_iso230(dataset)
    label(charts["iso230"], sheet.tell)
    shown = {"sheet": sheet, "iso230": part, "remarks": remarks, "summary": summary}
    return render_page("iso230.html.j2", embed(charts), **shown)


def label(chart: Chart, tell: Translate) -> None:
    """Name the axes of a chart in a language."""
    for axis in (chart.figure.below[0], chart.figure.left[0]):
        axis.axis_label = tell(axis.axis_label)


def write_iso230(path: Path, sheet: Sheet, part: Iso230Part, dataset: xr.Dataset, *, remarks: tuple[str, ...]) -> None:
    """Write the sheet of a test in the format of the file's name; nothing is replaced."""
    _write(
        path,
        lambda: [(sheet, plot_iso230(group(dataset, "quoted"), dataset["position"]))],
        lambda: render_iso230(sheet, part, dataset, remarks=remarks),
    )


def render_thermal_tests(sheets: Sequence[Sheet], tests: Sequence[ThermalTest]) -> str:
    """Return the page of tests by ISO 230-3 as HTML text: their sheets, then what they rest on."""
    summary = {"thermal_tests": describe_thermal_tests(tests), "assumptions": {"iso230-3": ""}}
    charts = draw_thermal_tests(tests)
    for chart in charts.values():
        label(chart, sheets[0].tell)
    return render_page("iso230_3.html.j2", embed(charts), sheets=sheets, summary=summary)


def write_thermal_tests(
    path: Path, title: str, tests: Sequence[ThermalTest], *, files: Mapping[str, str], own: Letterhead = PLAIN
) -> None:
    """Write the sheets of tests by ISO 230-3 in the format of the file's name; nothing is replaced."""
    sheets = [describe_thermal_sheet(title, one, files=files, own=own) for one in tests]
    drawn = zip(sheets, map(plot_thermal_test, tests), strict=True)
    _write(path, lambda: [*drawn], lambda: render_thermal_tests(sheets, tests))


def plot_thermal_test(test: ThermalTest) -> Axes:
    """Plot the displacements of a test by ISO 230-3 over time."""
    axes = new_axes(None)
    drawn = [one for one in test.courses if one.unit == "um"][:DRAWN]
    for rank, one in enumerate(drawn):
        look = of_rank(rank)
        values = np.array(one.values, float)
        axes.plot(one.hours, values, color=look["colour"], linestyle=_LINES[look["dash"]])
    axes.set(xlabel="time since start / h", ylabel="drift / µm")
    # A name from a file may begin with an underscore, and is no formula.
    legend = axes.legend(axes.lines, [" "] * len(axes.lines), frameon=False, ncols=2)
    for text, one in zip(legend.get_texts(), drawn, strict=True):
        shown = one.name if len(one.name) <= _LONGEST_LABEL else f"{one.name[: _LONGEST_LABEL - 1]}…"
        text.set(text=shown, parse_math=False)
    return axes


def _write_word(path: Path, sheets: Sequence[tuple[Sheet, Axes | None]]) -> None:
    """Write sheets, one on each page, as a document of Word that a laboratory may complete with its own heading."""
    import docx
    from docx.shared import Mm, Pt

    # XML holds no control characters.
    clean = partial(ACTING.sub, " ")
    own, tell = sheets[0][0].own, sheets[0][0].tell
    document = docx.Document(own.word_template or None)
    page = document.sections[0]
    if not own.word_template:
        page.page_width, page.page_height = Mm(210), Mm(297)
        page.left_margin = page.right_margin = Mm(16)
        page.top_margin = page.bottom_margin = Mm(12)
        normal = document.styles["Normal"]
        normal.font.name, normal.font.size, normal.paragraph_format.space_after = "Arial", Pt(7), Pt(0)
    styles = {style.name for style in document.styles}
    if own.logo:
        page.header.paragraphs[0].add_run().add_picture(own.logo, height=Mm(12))
    for line in own.lines:
        page.header.add_paragraph(clean(line))

    def put(rows: Iterable[Sequence[str]], widths_mm: Sequence[int], titles: Sequence[str] = ()) -> None:
        every = [*([titles] if titles else []), *rows]
        # A template of a laboratory may lack the styles of the program's own.
        grid = document.add_table(
            rows=len(every), cols=len(every[0]), style="Table Grid" if "Table Grid" in styles else None
        )
        grid.autofit = False
        for column, width in zip(grid.columns, widths_mm, strict=False):
            column.width = Mm(width)
        for cells, texts in zip(grid.rows, every, strict=True):
            for cell, text, width in zip(cells.cells, texts, widths_mm, strict=False):
                cell.text, cell.width = clean(text), Mm(width)
        document.add_paragraph()

    pairs = (32, 57, 32, 57)
    for number, (sheet, axes) in enumerate(sheets):
        if number:
            document.add_page_break()
        document.add_paragraph(clean(sheet.title), style="Heading 1" if "Heading 1" in styles else None)
        document.add_paragraph(clean(sheet.standard))
        put(in_pairs(sheet.stated.identity), pairs)
        if axes is not None:
            document.add_picture(_picture(axes, tell), width=Mm(125))
        document.add_paragraph(sheet.caption)
        # The first column holds names, the others share what is left of the width.
        titles = sheet.values.titles
        put([row.cells for row in sheet.values.rows], (58, *[120 // (len(titles) - 1)] * (len(titles) - 1)), titles)
        for note in sheet.notes:
            document.add_paragraph(note)
        if sheet.requirements.rows:
            put([row.cells for row in sheet.requirements.rows], (44, 18, 116), sheet.requirements.titles)
        if sheet.stated.conditions:
            put(in_pairs(sheet.stated.conditions), pairs)
        put([[f"{role}: {name}\n", tell("Date, signature:")] for role, name in sheet.stated.signatures], (89, 89))
        hashes = "; ".join(f"{name} {sha256}" for name, sha256 in sheet.files.items())
        document.add_paragraph(clean(f"thermofuse {sheet.version}. SHA-256: {hashes}"))
    document.save(str(path))


def _picture(axes: Axes, tell: Translate) -> io.BytesIO:
    """Return a chart as a picture, with its axes named in a language."""
    axes.set(xlabel=tell(axes.get_xlabel()), ylabel=tell(axes.get_ylabel()))
    drawn = axes.get_figure(root=True)
    assert drawn is not None
    picture = io.BytesIO()
    with warnings.catch_warnings():
        # A character that the font of charts lacks is a box there, and itself in the table below.
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        drawn.savefig(picture, format="png", dpi=200, transparent=False)
    return picture


def in_pairs(rows: Sequence[tuple[str, str]]) -> list[tuple[str, str, str, str]]:
    """Return names and texts as rows of two pairs, down the first column and then the second."""
    half = (len(rows) + 1) // 2
    right = [*rows[half:], ("", "")]
    return [(*rows[k], *right[k]) for k in range(half)]


def iso230_tables(
    part: Iso230Part, dataset: xr.Dataset, *, title: str, axis_alone: bool = False
) -> list[rich.table.Table]:
    """Return the tables of a test for the terminal: all of them, or the values of the axis as the sheet has them."""
    described = describe_iso230(part, dataset)
    shown: list[tuple[str, Table | None]] = [
        (f"{title}, {part.window}", values_to_sign(part) if axis_alone else described["axis"])
    ]
    if not axis_alone:
        shown += [("per target position", described["positions"]), ("uncertainty budget", described["budget"])]
    return [print_table(found, name) for name, found in shown if found is not None]


def iso230_json(part: Iso230Part, dataset: xr.Dataset) -> dict[str, Any]:
    """Return the values of a test for programs: the part ``iso230`` of results.json, and the values per target."""
    records = _of_targets(dataset).astype(object).to_dict("records")
    rows = [{name: None if value != value else value for name, value in record.items()} for record in records]
    return {**part.model_dump(mode="json"), "targets": rows}


def iso230_csv(dataset: xr.Dataset) -> str:
    """Return the values per target as CSV text, one line per target."""
    return _of_targets(dataset).to_csv(index=False, lineterminator="\n")


def _of_targets(dataset: xr.Dataset) -> pd.DataFrame:
    """Return the values of each target; headings carry the units of the dataset."""
    unit, place = dataset["deviation"].attrs["units"], dataset["position"].attrs["units"]
    columns = {"target": dataset["target"].values, f"position_{place}": dataset["position"].values}
    quoted = group(dataset, "quoted").sel(target=dataset["target"].values)
    for direction in dataset["direction"].values:
        here = quoted.sel(direction=direction)
        for symbol, name in (("mean", "mean_unidirectional"), ("s", "standard_deviation"), ("R", "repeatability")):
            columns[f"{symbol}_{direction}_{unit}"] = here[name].values
        columns[f"readings_{direction}"] = here["count"].values.astype(int)
    for symbol, name in (("mean", "mean_bidirectional"), ("B_i", "reversal"), ("R_i", "repeatability_bidirectional")):
        columns[f"{symbol}_{unit}"] = quoted[name].values
    return pd.DataFrame(columns)
