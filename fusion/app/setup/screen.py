"""The screen *Set up*: a folder, what was recognised in it, and below that the editor of its campaign file."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Any

import panel as pn

from fusion.app import parts as ui
from fusion.app.setup.folder import LARGEST_MB, found_in_folder, store_upload
from fusion.common.messages import BAD_INPUT

if TYPE_CHECKING:
    from fusion.app.setup.editor import CampaignEditor, Opened


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
