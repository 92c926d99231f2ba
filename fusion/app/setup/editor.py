"""The campaign file of a folder on the screen *Set up*: recordings, fiducials, plan and form, saved and checked."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from numpy.typing import NDArray

from fusion.app import parts as ui
from fusion.app.parts import beside, column, heading, note, table
from fusion.app.setup import plan as places
from fusion.app.setup.campaign import CampaignText, open_campaign
from fusion.app.setup.form import (
    FieldError,
    Form,
    direction_text,
    form_fields,
    is_picture,
    missing,
    read_direction,
    with_unit,
    write_fields,
)
from fusion.app.setup.plan import FrameView, Placed, Plan, PlanView, RegionsView
from fusion.app.setup.times import TimesView, recordings_of
from fusion.campaign.columns import ROLES, TableProposal
from fusion.campaign.draft import Asker, separate_tests, write_campaigns
from fusion.campaign.inspect import FolderContent, Kind, Recording, scan_folder
from fusion.campaign.values import QuantityError, read_quantity
from fusion.common.messages import BAD_INPUT
from fusion.pipeline.check import CampaignCheck, check_campaign
from fusion.results.progress import counted
from interferometry.common import InterferometryError
from thermography.common import ThermographyError
from thermography.registration.plan import Fiducial, PlanGrid, read_fiducials

# The columns of a record: first values, role and unit of each, as `thermofuse init` proposes them.


class ColumnsView:
    """First rows of a table, and a field for the role and the unit of every column."""

    def __init__(self) -> None:
        self._widgets: dict[str, tuple[pn.widgets.Select, pn.widgets.TextInput]] = {}
        self.view = column()

    def show(self, proposed: TableProposal | None, stated: Mapping[str, Mapping[str, str]]) -> None:
        """Show the columns of a table with the roles and units that a campaign file states."""
        self._widgets = {}
        if proposed is None:
            self.view[:] = []
            return
        rows = [(one.heading, *one.first, one.span, one.remark) for one in proposed.columns]
        width = max(map(len, rows))
        rows = [(*row[:-2], *[""] * (width - len(row)), *row[-2:]) for row in rows]
        first = [f"row {k}" for k in range(1, width - 2)]
        shown = table(
            ("column", *first, "range", "remark"),
            rows,
            caption=f"{proposed.path.name}, {counted(proposed.rows, 'row')}",
        )
        for one in proposed.columns:
            if one.role != "time":
                now = stated.get(one.heading, {"role": "out", "unit": one.unit})
                self._widgets[one.heading] = (
                    pn.widgets.Select(
                        label=f"{one.heading} holds", options=list(ROLES[1:]), value=now["role"], width=150
                    ),
                    pn.widgets.TextInput(
                        label=f"Unit of {one.heading}", value=now["unit"], placeholder="degC", width=150
                    ),
                )
        told = note("Columns that are out are not read. A unit may be that of one count, such as 0.0125 mm.")
        pairs = [pn.Row(*pair) for pair in self._widgets.values()]
        self.view[:] = [heading("Columns of the record", level=3), shown, told, beside(*pairs)]

    @property
    def stated(self) -> dict[str, dict[str, Any]]:
        """Role and unit of every column that is not out, as the campaign file holds them."""
        return {
            name: {"role": role.value, "unit": unit.value.strip()}
            for name, (role, unit) in self._widgets.items()
            if role.value != "out"
        }


@dataclass(frozen=True)
class Opened:
    """What was read from a folder: its campaign file or the draft of one, the first thermogram (row, column; degC) with the fiducials
    found in it, what was recorded when, the axis positions of the targets, the table of a record, what could not be shown, and how many
    tests of an axis the folder holds where each is a campaign of its own.
    """

    folder: Path
    campaign: CampaignText
    frame: NDArray[np.float64] | None
    placed: Placed
    recordings: list[Recording]
    positions_mm: tuple[float, ...]
    table: TableProposal | None
    remarks: list[str]
    tests: int = 0


def open_folder(root: Path, folder: Path) -> Opened:
    """Read what the screen shows of a folder."""
    content, campaign = scan_folder(folder, within=root), open_campaign(folder, root)
    remarks: list[str] = []
    tests = len(separate_tests(content)) if campaign.saved is None else 0
    if tests:
        remarks.append(
            f"{tests} tests of an axis are in this folder, each a campaign of its own in a folder of its own; thermofuse fleet runs them "
            "all. Shown is the first alone."
        )
    frame, placed = None, Placed()
    if content.frames:
        try:
            frame = places.first_thermogram(content.frame_files, of_temperatures=content.of_temperatures)
            listed = listed_fiducials(root, campaign)
            placed = places.find(frame, listed, grid_of(campaign)) if listed else places.place([], frame.shape)
        except BAD_INPUT as error:
            remarks.append(str(error))
    table = None
    if campaign.value("record", "columns") is not None and content.of(Kind.RECORD):
        table = content.of(Kind.RECORD)[0].content
    return Opened(folder, campaign, frame, placed, recordings_of(content), positions_of(content), table, remarks, tests)


def listed_fiducials(root: Path, campaign: CampaignText) -> list[Fiducial]:
    """Return the fiducials that a campaign file names; none where it names no list."""
    name = campaign.value("plan", "fiducials")
    return read_fiducials(ui.allowed_path(root, campaign.path.parent / name)) if isinstance(name, str) else []


def grid_of(campaign: CampaignText) -> PlanGrid | None:
    """Return the plan that a campaign file states, None where its sides are missing."""
    try:
        width, height = (read_quantity(side, "mm") for side in campaign.value("plan", "size") or [None, None])
        cell = campaign.value("plan", "cell_size")
        return PlanGrid(width, height, read_quantity(cell, "mm") if cell else width)
    except (QuantityError, ThermographyError, ValueError, TypeError):
        return None


def positions_of(content: FolderContent) -> tuple[float, ...]:
    """Return the axis positions of the targets in a folder, mm; none where its deviations cannot be read."""
    for one in content.of(Kind.DEVIATIONS)[:1]:
        with suppress(InterferometryError):
            return tuple(np.unique(one.content["position"].values).tolist())
    return ()


class CampaignEditor:
    """The campaign file of an opened folder, drawn and typed, saved and checked."""

    def __init__(self, state: ui.State) -> None:
        self._state = state
        self._opened: Opened | None = None
        self._form = Form(self._on_field)
        self._frame = FrameView(self._draw_plan)
        self._regions = RegionsView(self._draw_plan)
        self._columns = ColumnsView()
        self._plan = PlanView(
            lambda x, y: self._form.write(
                {"plan.axis.origin.0": f"{round(x):g} mm", "plan.axis.origin.1": f"{round(y):g} mm"}
            ),
            lambda dx, dy: self._form.write({"plan.axis.direction": direction_text(dx, dy)}),
            self._regions.take_point,
            self._regions.take_corners,
        )
        self._times = TimesView(lambda offset: self._form.write({"thermography.clock_offset": f"{offset:g} s"}))
        self._save = pn.widgets.Button(label="Save campaign.toml and check it", color="primary")
        self._go = pn.widgets.Button(label="Go to Run", visible=False)
        self._split = pn.widgets.Button(label="Write a campaign for each test", color="primary")
        self._remarks, self._checked = ui.column(), ui.column()
        pictures = (self._times.view, self._frame.view, self._plan.view, self._regions.view)
        answer = ui.column(self._checked, styles={"max-height": "38vh", "overflow-y": "auto"})
        self.saving = ui.column(ui.beside(self._save, self._go), answer)
        shown = (self._form.required, *pictures, self._columns.view, self._form.view)
        self.view = ui.column(self._remarks, *shown)
        self._save.on_click(self._on_save)
        self._split.on_click(self._on_split)
        self._go.on_click(lambda event: setattr(state, "screen", "Run"))

    def show(self, opened: Opened) -> None:
        """Show what was read."""
        self._opened = opened
        remarks = [ui.paragraph(remark, kind="warning") for remark in opened.remarks]
        self._remarks[:] = [*remarks, *([self._split] if opened.tests else [])]
        self._form.show(opened.campaign)
        self._columns.show(opened.table, opened.campaign.value("record", "columns") or {})
        regions = opened.campaign.value("thermography", "region")
        picture = is_picture(opened.campaign)
        self._regions.show(list(regions) if isinstance(regions, list) else [], "px" if picture else "mm")
        for view in (self._frame, self._plan, self._regions):
            view.view.visible = opened.frame is not None and not (picture and view is self._frame)
        self._times.show(opened.recordings, self._offset_s())
        if opened.frame is not None:
            self._frame.show(opened.frame, opened.placed, grid_of(opened.campaign))
        self._checked[:] = []
        self._go.visible = False
        if self._state.folder != opened.folder:
            # Looking again into the same folder leaves what was chosen on another screen meanwhile.
            self._state.folder = opened.folder
            self._state.campaign = None if opened.campaign.saved is None else opened.campaign.path

    def _quantity(self, name: str, unit: str) -> float | None:
        """Return the quantity in a field; None where there is none."""
        try:
            return read_quantity(with_unit(self._form.texts.get(name, ""), unit), unit)
        except QuantityError:
            return None

    def _offset_s(self) -> float:
        return self._quantity("thermography.clock_offset", "s") or 0.0

    def _on_field(self, name: str) -> None:
        if name == "thermography.clock_offset":
            self._times.move(self._offset_s())
        elif name.startswith("plan."):
            self._draw_plan()

    def _draw_plan(self) -> None:
        """Draw the plan from the fields, the fiducials and the regions; nothing where its sides are missing."""
        sides = ("plan.size.0", "plan.size.1", "plan.axis.origin.0", "plan.axis.origin.1")
        width, height, x, y = (self._quantity(name, "mm") for name in sides)
        opened = self._opened
        if opened is not None and opened.frame is not None and is_picture(opened.campaign):
            height, width = (float(size) for size in opened.frame.shape)
        if opened is None or not width or not height or width <= 0 or height <= 0:
            return
        try:
            direction = read_direction(self._form.texts.get("plan.axis.direction", ""))
        except FieldError:
            direction = None
        origin = None if x is None or y is None else (x, y)
        unit = "px" if is_picture(opened.campaign) else "mm"
        plan = Plan(width, height, origin, direction, opened.positions_mm, tuple(self._regions.outlines), unit)
        self._plan.show(plan, self._frame.placed, opened.frame)

    async def _on_split(self, event: object) -> None:
        """Write a campaign for each test of the folder, as `thermofuse init` does, and show where they are."""
        assert self._opened is not None
        with ui.disabled_during(self._split), ui.telling(self._remarks):
            written = await asyncio.to_thread(write_campaigns, self._opened.folder, Asker(None))
            told = [
                f"{path}{': to be filled in: ' + ', '.join(lacking) if lacking else ''}" for path, lacking in written
            ]
            done = ui.paragraph("Written; look into their folders above to complete and run them:", kind="done")
            ui.schedule_parts(self._remarks, [done, ui.bullets(told)])

    async def _on_save(self, event: object) -> None:
        """Write the campaign file and the list of fiducials, and check both."""
        if self._opened is None:
            return
        with ui.disabled_during(self._save), ui.telling(self._checked):
            ui.schedule_parts(self._checked, [])
            campaign = self._write(self._opened)
            lacking = missing(campaign)
            if lacking:
                told = ui.paragraph("Saved. Before it can run, fill in:", kind="warning")
                ui.schedule_parts(self._checked, [told, ui.bullets(lacking)])
                return
            ui.schedule_parts(self._checked, [ui.note("Checking ...")])
            checked = await asyncio.to_thread(check_campaign, campaign.path)
            ui.schedule_update(lambda: self._ready(campaign.path, checked))

    def _ready(self, campaign: Path, checked: CampaignCheck) -> None:
        """Show the check of the saved file, and lead on to the run."""
        self._checked[:] = told_of_check(checked)
        self._go.visible = not checked.faults
        self._state.campaign = campaign

    def _write(self, opened: Opened) -> CampaignText:
        """Write what the screen shows; the list of fiducials where it was changed here."""
        campaign = write_fields(opened.campaign, self._form.texts)
        regions = self._regions.regions
        stated = campaign.value("thermography", "region")
        if regions != (stated or []) and (regions or isinstance(stated, list)):
            campaign = campaign.with_values({("thermography", "region"): regions or None})
        if opened.table is not None and self._columns.stated != campaign.value("record", "columns"):
            campaign = campaign.with_values({("record", "columns"): self._columns.stated})
        placed = self._frame.placed
        if opened.frame is not None and placed.fiducials != opened.placed.fiducials:
            written = places.write_picked(opened.folder, placed)
            campaign = campaign.with_values({("plan", "fiducials"): written.name})
        saved = campaign.save()
        self._opened = replace(opened, campaign=saved, placed=placed)
        if form_fields(saved).keys() != form_fields(opened.campaign).keys():
            # An instrument was added: there is room for another one.
            self._form.show(saved)
        return saved


def told_of_check(checked: CampaignCheck) -> ui.Parts:
    """Return a check of a campaign as parts of a screen."""
    doubts = [ui.paragraph(f"{one.evidence} {one.remedy}", kind="warning") for one in checked.doubts]
    if checked.faults:
        told = ("Saved, but not ready to run:", *checked.faults)
        return [*(ui.paragraph(one, kind="fault") for one in told), *doubts]
    notices = [ui.paragraph(f"{one.message} {one.remedy}".strip(), kind="warning") for one in checked.notices]
    ready = f"Saved and ready to run: {len(checked.checks) - len(checked.doubts)} checks passed."
    return [ui.paragraph(ready, kind="done"), ui.bullets(checked.content), *doubts, *notices]
