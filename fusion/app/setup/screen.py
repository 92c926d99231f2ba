"""The screen *Set up*."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from numpy.typing import NDArray

from fusion.app.elements import bullets, heading, paragraph
from fusion.app.places import PlaceError, folder_within, place_within
from fusion.app.setup import fiducials as places
from fusion.app.setup.campaign_text import CampaignText, open_campaign
from fusion.app.setup.fiducials import Placed
from fusion.app.setup.fields import FieldError, direction_text, missing, read_direction, write_fields
from fusion.app.setup.form import Form
from fusion.app.setup.found import found_in_folder
from fusion.app.setup.frame_view import FrameView
from fusion.app.setup.plan_view import Plan, PlanView, corners_of
from fusion.app.setup.regions_view import RegionsView
from fusion.app.setup.times import recordings_of
from fusion.app.setup.times_view import TimesView
from fusion.app.setup.upload import LARGEST_MB, store_upload
from fusion.app.state import State
from fusion.app.turn import in_turn
from fusion.campaign.quantities import QuantityError, read_quantity
from fusion.errors import FusionError
from fusion.starting.check import CampaignCheck, check_campaign
from fusion.starting.folder import FolderContent, scan_folder
from fusion.starting.kinds import Kind
from fusion.starting.time_bars import Recording
from interferometry.errors import InterferometryError
from interferometry.io.readers import read_deviations
from thermography.errors import ThermographyError
from thermography.registration.plan import Fiducial, PlanGrid, read_fiducials

_BAD_INPUT = (FusionError, ThermographyError, InterferometryError, OSError)


@dataclass(frozen=True)
class Opened:
    """What was read from a folder.

    Attributes
    ----------
    folder : Path
        The folder.
    campaign : CampaignText
        Its campaign file, or the draft of one.
    frame : (row, column) ndarray or None, degC
        First thermogram.
    placed : Placed
        Fiducials, found in it.
    recordings : list of Recording
        What was recorded when.
    positions_mm : tuple of float
        Axis positions of the targets.
    remarks : list of str
        What could not be shown, and why.
    """

    folder: Path
    campaign: CampaignText
    frame: NDArray[np.float64] | None
    placed: Placed
    recordings: list[Recording]
    positions_mm: tuple[float, ...]
    remarks: list[str]


def open_folder(root: Path, folder: Path) -> Opened:
    """Read what the screen shows of a folder.

    Parameters
    ----------
    root : Path
        Folder for which the application was started.
    folder : Path
        Folder inside it.

    Raises
    ------
    FusionError
        If it holds nothing for a campaign, or a campaign file that cannot be read.
    """
    content, campaign = scan_folder(folder), open_campaign(folder)
    remarks: list[str] = []
    frame, placed = None, Placed()
    if content.frames:
        try:
            frame = places.first_thermogram(content.frame_files, of_temperatures=content.of_temperatures)
            listed = listed_fiducials(root, campaign)
            placed = places.find(frame, listed, grid_of(campaign)) if listed else places.place([], frame.shape)
        except _BAD_INPUT as error:
            remarks.append(str(error))
    return Opened(folder, campaign, frame, placed, recordings_of(content), positions_of(content), remarks)


def listed_fiducials(root: Path, campaign: CampaignText) -> list[Fiducial]:
    """Return the fiducials that a campaign file names; none where it names no list.

    Parameters
    ----------
    root : Path
        Folder for which the application was started.
    campaign : CampaignText
        Opened file.
    """
    name = campaign.value("plan", "fiducials")
    return read_fiducials(place_within(root, campaign.path.parent / name)) if isinstance(name, str) else []


def grid_of(campaign: CampaignText) -> PlanGrid | None:
    """Return the plan that a campaign file states, None where its sides are missing.

    Parameters
    ----------
    campaign : CampaignText
        Opened file.
    """
    try:
        width, height = (read_quantity(side, "mm") for side in campaign.value("plan", "size") or [None, None])
        cell = campaign.value("plan", "cell_size")
        return PlanGrid(width, height, read_quantity(cell, "mm") if cell else width)
    except (QuantityError, ThermographyError, ValueError, TypeError):
        return None


def positions_of(content: FolderContent) -> tuple[float, ...]:
    """Return the axis positions of the targets in a folder, mm; none where its deviations cannot be read.

    Parameters
    ----------
    content : FolderContent
        What the folder holds.
    """
    for one in content.of(Kind.DEVIATIONS)[:1]:
        try:
            return tuple(np.unique(read_deviations(one.path)["position"].values).tolist())
        except InterferometryError:
            return ()
    return ()


class SetUpScreen:
    """From a folder to a campaign file.

    Parameters
    ----------
    state : State
        Of the page.
    """

    def __init__(self, state: State) -> None:
        self._state = state
        self._opened: Opened | None = None
        self._listed: tuple[Fiducial, ...] = ()
        self._folder = pn.widgets.TextInput(
            label="Folder of the measurement", value=str(state.folder or state.root), sizing_mode="stretch_width"
        )
        self._look = pn.widgets.Button(label="Look into it", align="end")
        self._drop = pn.widgets.FileDropper(
            multiple=True, previews=[], max_file_size=f"{LARGEST_MB}MB", sizing_mode="stretch_width"
        )
        self._dropped = pn.Column(sizing_mode="stretch_width")
        self._taken: set[str] = set()
        self._found = pn.Column(sizing_mode="stretch_width")
        self._form = Form(self._on_field)
        self._frame = FrameView(self._draw_plan)
        self._plan = PlanView(
            self._on_origin, self._on_direction, lambda one, other: self._regions.take_corners(one, other)
        )
        self._regions = RegionsView(self._draw_plan)
        self._times = TimesView(lambda offset: self._form.write({"clock_offset": f"{offset:g} s"}))
        self._save = pn.widgets.Button(label="Save campaign.toml and check it", color="primary")
        self._go = pn.widgets.Button(label="Go to Run", visible=False)
        self._checked = pn.Column(sizing_mode="stretch_width")
        self._work = pn.Column(sizing_mode="stretch_width", visible=False)
        self._look.on_click(self.look)
        self._save.on_click(self._on_save)
        self._go.on_click(lambda event: setattr(state, "screen", "Run"))
        self._drop.param.watch(self._on_drop, "value")

    @property
    def view(self) -> pn.viewable.Viewable:
        """The screen."""
        self._work[:] = [
            self._times.view,
            self._frame.view,
            self._plan.view,
            self._regions.view,
            self._form.view,
            pn.FlexBox(self._save, self._go),
            self._checked,
        ]
        return pn.Column(
            heading("Set up"),
            pn.Row(self._folder, self._look, sizing_mode="stretch_width"),
            paragraph(f"Files can be dropped here; they go into this folder, up to {LARGEST_MB} MB each.", kind="note"),
            self._drop,
            self._dropped,
            self._found,
            self._work,
            sizing_mode="stretch_width",
        )

    async def look(self, event: object = None) -> None:
        """Look into the folder that is typed, and show what is in it."""
        try:
            folder = folder_within(self._state.root, self._folder.value)
        except PlaceError as error:
            self._found[:] = [paragraph(str(error), kind="fault")]
            return
        in_turn(self._begin_look)
        try:
            found = await asyncio.to_thread(found_in_folder, folder)
            in_turn(lambda: self._tell(found))
            opened = await asyncio.to_thread(open_folder, self._state.root, folder)
            in_turn(lambda: self._show(opened))
        except _BAD_INPUT as error:
            told = paragraph(str(error), kind="fault")
            in_turn(lambda: self._tell([*self._found, told]))
        finally:
            in_turn(self._end_look)

    def _begin_look(self) -> None:
        self._look.disabled = True
        self._dropped[:] = []
        self._work.visible = False
        self._tell([paragraph("Looking into the files ...", kind="note")])

    def _end_look(self) -> None:
        self._look.disabled = False

    def _tell(self, parts: Sequence[Any]) -> None:
        """Show what was found."""
        self._found[:] = list(parts)

    def _show(self, opened: Opened) -> None:
        """Show what was read."""
        self._opened, self._listed = opened, opened.placed.fiducials
        self._found.extend(paragraph(remark, kind="warning") for remark in opened.remarks)
        self._form.show(opened.campaign)
        regions = opened.campaign.value("thermography", "region")
        self._regions.show(list(regions) if isinstance(regions, list) else [])
        has_frame = opened.frame is not None
        self._frame.view.visible = has_frame
        self._plan.view.visible = self._regions.view.visible = has_frame
        self._times.show(opened.recordings, self._offset_s())
        if opened.frame is not None:
            self._frame.show(opened.frame, opened.placed, grid_of(opened.campaign))
        self._checked[:] = []
        self._go.visible = False
        self._work.visible = True
        if self._state.folder != opened.folder:
            # Looking again into the same folder leaves what was chosen on another screen meanwhile.
            self._state.folder = opened.folder
            self._state.campaign = None if opened.campaign.saved is None else opened.campaign.path

    def _offset_s(self) -> float:
        try:
            return read_quantity(self._form.texts.get("clock_offset", ""), "s")
        except QuantityError:
            return 0.0

    def _on_field(self, name: str) -> None:
        if name == "clock_offset":
            self._times.move(self._offset_s())
        elif name in ("width", "height", "origin_x", "origin_y", "direction"):
            self._draw_plan()

    def _on_origin(self, x_mm: float, y_mm: float) -> None:
        self._form.write({"origin_x": f"{round(x_mm):g} mm", "origin_y": f"{round(y_mm):g} mm"})

    def _on_direction(self, dx: float, dy: float) -> None:
        self._form.write({"direction": direction_text(dx, dy)})

    def _draw_plan(self) -> None:
        """Draw the plan from the fields, the fiducials and the regions."""
        plan = self._drawn()
        if plan is not None and self._opened is not None:
            self._plan.show(plan, self._frame.placed, self._opened.frame)

    def _drawn(self) -> Plan | None:
        """Return the plan as the fields state it; None where its sides are missing."""
        texts = self._form.texts

        def length(text: str) -> float | None:
            try:
                return read_quantity(text, "mm")
            except QuantityError:
                return None

        width, height, x, y = (length(texts.get(name, "")) for name in ("width", "height", "origin_x", "origin_y"))
        if not width or not height or width <= 0 or height <= 0:
            return None
        try:
            direction = read_direction(texts.get("direction", ""))
        except FieldError:
            direction = None
        regions = [
            (str(one.get("name", "")), corners_of(one, lambda text: read_quantity(text, "mm")))
            for one in self._regions.regions
        ]
        return Plan(
            width,
            height,
            None if x is None or y is None else (x, y),
            direction,
            () if self._opened is None else self._opened.positions_mm,
            tuple((name, corners) for name, corners in regions if corners is not None),
        )

    def _on_drop(self, event: Any) -> None:
        """Write what was dropped into the folder; its content is not kept in memory, its line in the list of the page stays."""
        dropped: dict[str, Any] = event.new
        self._taken &= set(dropped)
        for name in [name for name in dropped if name not in self._taken]:
            try:
                path = store_upload(self._state.root, Path(self._folder.value), name, dropped[name])
                told = paragraph(f"{path.name} is in the folder now; look into it.", kind="done")
            except _BAD_INPUT as error:
                told = paragraph(str(error), kind="fault")
            self._taken.add(name)
            dropped[name] = b""
            self._dropped.append(told)

    async def _on_save(self, event: object) -> None:
        """Write the campaign file and the list of fiducials, and check both."""
        if self._opened is None:
            return
        in_turn(self._begin_save)
        try:
            campaign = self._write(self._opened)
            self._opened = Opened(**{**vars(self._opened), "campaign": campaign})
            lacking = missing(campaign)
            if lacking:
                told = [paragraph("Saved. Before it can run, fill in:", kind="warning"), bullets(lacking)]
                in_turn(lambda: self._tell_check(told))
                return
            in_turn(lambda: self._tell_check([paragraph("Checking ...", kind="note")]))
            checked = await asyncio.to_thread(check_campaign, campaign.path)
            in_turn(lambda: self._ready(campaign.path, checked))
        except _BAD_INPUT as error:
            faults = [paragraph(line, kind="fault") for line in str(error).splitlines()]
            in_turn(lambda: self._tell_check(faults))
        finally:
            in_turn(self._end_save)

    def _begin_save(self) -> None:
        self._save.disabled = True
        self._tell_check([])

    def _end_save(self) -> None:
        self._save.disabled = False

    def _tell_check(self, parts: Sequence[Any]) -> None:
        """Show what became of saving."""
        self._checked[:] = list(parts)

    def _ready(self, campaign: Path, checked: CampaignCheck) -> None:
        """Show the check of the saved file, and lead on to the run."""
        self._tell_check(told_of_check(checked))
        self._go.visible = not checked.faults
        self._state.campaign = campaign

    def _write(self, opened: Opened) -> CampaignText:
        """Write what the screen shows; the list of fiducials where it was changed here."""
        campaign = write_fields(opened.campaign, self._form.texts)
        regions = self._regions.regions
        stated = campaign.value("thermography", "region")
        if regions != (stated or []) and (regions or isinstance(stated, list)):
            campaign = campaign.with_values({("thermography", "region"): regions or None})
        if opened.frame is not None and self._frame.placed.fiducials != self._listed:
            written = places.write_picked(opened.folder, self._frame.placed)
            campaign = campaign.with_values({("plan", "fiducials"): written.name})
            self._listed = self._frame.placed.fiducials
        return campaign.save()


def told_of_check(checked: CampaignCheck) -> list[pn.viewable.Viewable]:
    """Return a check of a campaign as parts of a screen.

    Parameters
    ----------
    checked : CampaignCheck
        Of the file that was saved.
    """
    doubts = [paragraph(f"{one.evidence} {one.remedy}", kind="warning") for one in checked.doubts]
    notices = [paragraph(f"{one.message} {one.remedy}".strip(), kind="warning") for one in checked.notices]
    if checked.faults:
        return [
            paragraph("Saved, but not ready to run:", kind="fault"),
            *(paragraph(fault, kind="fault") for fault in checked.faults),
            *doubts,
        ]
    ready = f"Saved and ready to run: {len(checked.checks) - len(checked.doubts)} checks passed."
    return [paragraph(ready, kind="done"), bullets(checked.content), *doubts, *notices]


def set_up(state: State) -> pn.viewable.Viewable:
    """Build the screen *Set up* for a page.

    Parameters
    ----------
    state : State
        Of the page.

    Returns
    -------
    Viewable
        Of Panel.
    """
    screen = SetUpScreen(state)
    pn.state.onload(screen.look)
    return screen.view
