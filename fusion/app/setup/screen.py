"""The screen *Set up*: a folder, what was recognised in it, and below that the editor of its campaign file."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Any

import panel as pn

from fusion.app import parts as ui
from fusion.app.parts import PathError, allowed_folder, allowed_path, file_name, heading, paragraph, table
from fusion.campaign.inspect import Inspected, Kind, inspect_paths, leads_out
from fusion.common import FusionError
from fusion.common.messages import BAD_INPUT
from fusion.results.store import write_atomically

if TYPE_CHECKING:
    from fusion.app.setup.editor import CampaignEditor, Opened


# What was recognised in a folder, in the words of `thermofuse inspect`; files that are dropped on the page go into it.


def found_in_folder(folder: Path, root: Path | None = None) -> list[pn.viewable.Viewable]:
    """Return what a folder holds, as parts of a screen; links out of `root`, else of the folder, are named and not followed."""
    root = root or folder
    looked_into = list(inspect_paths([folder], within=root))
    if [one.label for one in looked_into] == [str(folder)]:
        return [paragraph(f"{folder} holds no file; put the files of the measurement into it", kind="fault")]
    usable = [one for one in looked_into if not one.fault]
    parts = [heading("What was recognised", level=3)]
    if usable:
        rows = [(name_in(folder, one), one.kind.value.words, "; ".join(one.content)) for one in usable]
        parts.append(table(("file or series", "kind", "content"), rows, caption=f"Files in {folder}", stacked=True))
    for one in looked_into:
        name = name_in(folder, one)
        if one.kind is Kind.CAMPAIGN and Path(name).parent != Path():
            told = f"{name} is the campaign file of a folder below; to open it, look into {folder / Path(name).parent}"
            parts.append(paragraph(told, kind="warning"))
        parts += [paragraph(f"{name}: {line.removeprefix('warning: ')}", kind="warning") for line in one.warnings]
        if one.fault:
            parts.append(paragraph(f"{name} is not used: {one.fault}", kind="fault" if one.fails else "warning"))
    for path in sorted(folder.iterdir()):
        if leads_out(path, root):
            told = f"{path.name} is a link to a place outside {root} and is not followed; copy what it leads to into the folder"
            parts.append(paragraph(told, kind="warning"))
    return parts


def name_in(folder: Path, one: Inspected) -> str:
    """Return the name of a file or a series within its folder."""
    return one.label.removeprefix(str(folder)).lstrip("/\\")


# Files that are dropped on the page.

#: Largest file that is taken, MB: it passes through the memory of the browser and of the application.
LARGEST_MB = 100


class UploadError(FusionError):
    """A file that is not taken; the message says why and what to do."""


def store_upload(root: Path, folder: Path, name: str, content: bytes | str) -> Path:
    """Write a file that was dropped on the page."""
    inside = allowed_folder(root, folder)
    data = content.encode("utf-8") if isinstance(content, str) else content
    if len(data) > LARGEST_MB * 1_000_000:
        raise UploadError(f"{name} is larger than {LARGEST_MB} MB; copy it into {inside} with the file manager")
    path = allowed_path(root, inside / file_name(name))
    if path.parent != inside:
        raise PathError(f"{name} leads out of {inside}; give the file a name without folders")
    if path.exists():
        raise UploadError(f"{path} exists already and is not replaced; give the file another name")
    return write_atomically(path, lambda part: part.write_bytes(data))


class SetUpScreen:
    """From a folder to a campaign file."""

    def __init__(self, state: ui.State) -> None:
        self._state = state
        self._folder = ui.text_field("Folder of the measurement", state.folder or state.root)
        self._look = pn.widgets.Button(label="Look into it", align="end")
        self._drop = pn.widgets.FileDropper(
            multiple=True, previews=[], max_file_size=f"{LARGEST_MB}MB", sizing_mode="stretch_width"
        )
        self._taken: set[str] = set()
        self._dropped, self._found, self._below = ui.column(), ui.column(), ui.column()
        # At the lower edge of the window, wherever the page stands.
        self._saving = ui.column(css_classes=["in-view"], visible=False)
        self.editor: CampaignEditor | None = None
        self._look.on_click(self.look)
        self._drop.param.watch(self._on_drop, "value")
        row = pn.Row(self._folder, self._look, sizing_mode="stretch_width")
        how = ui.note(f"Files can be dropped here; they go into this folder, up to {LARGEST_MB} MB each.")
        parts = (row, how, self._drop, self._dropped, self._found, self._below, self._saving)
        self.view = ui.column(ui.heading("Set up"), *parts)

    async def look(self, event: object = None) -> None:
        """Look into the folder that is typed, and show what is in it."""
        try:
            folder = ui.allowed_folder(self._state.root, self._folder.value)
        except ui.PathError as error:
            self._found[:] = ui.faults(error)
            return
        found: ui.Parts = []
        with ui.disabled_during(self._look), ui.telling(self._found, found):
            ui.schedule_parts(self._dropped, [])
            ui.schedule_parts(self._below, [])
            ui.schedule_update(lambda: self._saving.param.update(visible=False))
            ui.schedule_parts(self._found, [ui.note("Looking into the files ...")])
            found += await asyncio.to_thread(found_in_folder, folder, self._state.root)
            ui.schedule_parts(self._found, [*found, ui.note("Reading the first frame and the recordings ...")])
            opened = await asyncio.to_thread(_open, self._state.root, folder)
            ui.schedule_parts(self._found, found)
            ui.schedule_update(lambda: self._show(opened))
        ui.schedule_update(lambda: self._state.param.update(looked=self._state.looked + 1))

    def _show(self, opened: Opened) -> None:
        """Show the editor with what was read."""
        from fusion.app.setup.editor import CampaignEditor

        self.editor = self.editor or CampaignEditor(self._state)
        self.editor.show(opened)
        self._below[:] = [self.editor.view]
        self._saving.param.update(objects=[self.editor.saving], visible=True)

    def _on_drop(self, event: Any) -> None:
        """Write what was dropped into the folder; its content is not kept in memory, its line in the list of the page stays."""
        dropped: dict[str, Any] = event.new
        self._taken &= set(dropped)
        for name in [name for name in dropped if name not in self._taken]:
            try:
                path = store_upload(self._state.root, Path(self._folder.value), name, dropped[name])
                told = ui.paragraph(f"{path.name} is in the folder now; look into it.", kind="done")
            except BAD_INPUT as error:
                told = ui.paragraph(str(error), kind="fault")
            self._taken.add(name)
            dropped[name] = b""
            self._dropped.append(told)


def _open(root: Path, folder: Path) -> Opened:
    """Read a folder; what that imports is ready only after the page has shown what was recognised."""
    from fusion.app.setup.editor import open_folder

    return open_folder(root, folder)


def set_up(state: ui.State) -> pn.viewable.Viewable:
    """Build the screen *Set up* for a page."""
    screen = SetUpScreen(state)
    pn.state.onload(screen.look)
    return screen.view
