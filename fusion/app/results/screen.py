"""The screen *Results*."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import panel as pn

from fusion.app import parts as ui
from fusion.app.results.charts import ThermalView, position_readings
from fusion.app.results.data import Products, Selection
from fusion.common import FusionError, versions
from fusion.pipeline.iso230 import read_test
from fusion.pipeline.iso230_3 import read_thermal_tests
from fusion.report.page import ProductsError, print_pdf, report_of
from fusion.report.sheet import describe_sheet, write_iso230, write_thermal_tests
from fusion.results.store import write_atomically


def results_screen(state: ui.State) -> pn.viewable.Viewable:
    """Build the screen *Results* for a page: the results of the page, which change when these do."""
    field = ui.text_field("Results folder", state.results or state.root / "results")
    open_button = pn.widgets.Button(label="Open", color="primary", align="end")
    content = ui.column()
    stands: list[int | None] = []

    def show(folder: Path | None) -> None:
        stands[:] = [None if folder is None else _written(folder)]
        if folder is None:
            content[:] = [ui.note("No results are chosen: finish a run, or name the results folder of one.")]
            return
        field.value = str(folder)
        content[:] = _or_fault(lambda: _parts(state, Products(folder)))

    def open_typed(event: object) -> None:
        try:
            folder = ui.allowed_folder(state.root, field.value)
        except ui.PathError as error:
            content[:] = ui.faults(error)
            return
        if folder != state.results:
            state.results = folder
        elif stands != [_written(folder)]:
            # What stands is not built anew: a click on it that is under way would be lost.
            show(folder)

    open_button.on_click(open_typed)
    state.param.watch(lambda event: show(event.new), "results")
    show(state.results)
    return ui.column(ui.heading("Results"), pn.Row(field, open_button, sizing_mode="stretch_width"), content)


def _written(folder: Path) -> int | None:
    """Return when the results of a folder were written, in ns of the system's clock; None where there are none."""
    found = folder / "results.json"
    return found.stat().st_mtime_ns if found.is_file() else None


def _parts(state: ui.State, products: Products) -> ui.Parts:
    """The title, what is chosen, and the parts of the screen."""
    cycles, report = products.cycles, products.folder / "report.html"
    selection = Selection(cycle=int(cycles[-1]) if cycles.size else 0)
    builders: dict[str, tuple[bool, Callable[[], ui.Parts]]] = {
        "Report": (report.is_file(), lambda: [ui.frame("Report", ui.report_link(state.root, products.folder))]),
        "Map": (products.fields is not None, lambda: [ThermalView(products, selection).view]),
        "Readings": (products.drift is not None, lambda: _readings(products)),
    }
    shown = {name: build for name, (there, build) in builders.items() if there}
    if not shown:
        return [ui.paragraph(products.results.campaign), ui.note(f"{report} is missing: run the campaign again.")]
    parts = {name: partial(lambda build: ui.column(*_or_fault(build)), build) for name, build in shown.items()}
    chooser, part = ui.switched("Part", parts, next(iter(parts)))
    lead = [ui.paragraph(products.results.campaign)]
    if report.is_file():
        lead.append(ui.link("Open the report in a tab of its own", ui.report_link(state.root, products.folder)))
    return [*lead, _printing(state, products), chooser, part]


def _printing(state: ui.State, products: Products) -> pn.viewable.Viewable:
    """Buttons that write the test sheet, which is signed, and print the report; then a link to the file."""
    told, folder = ui.column(), products.folder

    def button(label: str, name: str, write: Callable[[Path], object]) -> pn.widgets.Button:
        made = pn.widgets.Button(label=label)

        async def make(event: object) -> None:
            with ui.disabled_during(made), ui.telling(told):
                ui.schedule_parts(told, [ui.note(f"Writing {name}, a PDF in half a minute ...")])
                await asyncio.to_thread(_put, folder / name, write)
                ui.schedule_parts(told, [ui.link(f"Save {name}", ui.report_link(state.root, folder, name))])

        made.on_click(make)
        return made

    report = button("Report as PDF", "report.pdf", lambda out: print_pdf(report_of(folder), out))
    results = products.results
    write = _write_sheet if results.iso230 is not None else _write_thermal_sheet if results.iso230_3 else None
    made = []
    if write is not None:
        sheets = {"PDF": "sheet.pdf", "Word": "sheet.docx"}
        made = [button(f"Test sheet to sign ({kind})", name, partial(write, folder)) for kind, name in sheets.items()]
    return ui.column(ui.beside(*made, report), told)


def _put(out: Path, write: Callable[[Path], object]) -> None:
    """Write a file in place of the one that is there, once it is whole."""
    with tempfile.TemporaryDirectory() as apart:
        whole = Path(apart) / out.name
        write(whole)
        write_atomically(out, lambda part: part.write_bytes(whole.read_bytes()))


def _write_sheet(results: Path, out: Path) -> None:
    """Write the test sheet of a run by ISO 230-2."""
    test = read_test(results, None)
    sheet = describe_sheet(test.title, test.part, files=test.files, version=versions()["thermofuse"], own=test.sheet)
    write_iso230(out, sheet, test.part, test.dataset, remarks=test.remarks)


def _write_thermal_sheet(results: Path, out: Path) -> None:
    """Write the sheets of a test by ISO 230-3."""
    title, tests, files, own = read_thermal_tests(results)
    if not all(one.conditions for one in tests):
        told = "these results are of an earlier version and do not say whose test it was; run the campaign again"
        raise ProductsError(f"{results}: {told}, finished stages are kept")
    write_thermal_tests(out, title, tests, files=files, version=versions()["thermofuse"], own=own)


def _or_fault(build: Callable[[], ui.Parts]) -> ui.Parts:
    """Return a part of the screen; where its product is damaged, the reason: the other parts are shown all the same."""
    try:
        return build()
    except FusionError as error:
        return [ui.paragraph(str(error), kind="fault")]


def _readings(products: Products) -> ui.Parts:
    """The readings of every position, first those of one that stands out."""
    assert products.deviations is not None and products.drift is not None
    flagged = [anomaly.target for anomaly in products.results.anomalies or ()]
    first = flagged[0] if flagged else int(products.deviations["target"].values[0])
    return position_readings(products.deviations, products.drift, first)
