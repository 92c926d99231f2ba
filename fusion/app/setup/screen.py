"""The screen *Set up*."""

from __future__ import annotations

import asyncio

import panel as pn

from fusion.app.elements import heading, paragraph
from fusion.app.places import PlaceError, folder_within
from fusion.app.setup.found import found_in_folder
from fusion.app.state import State


def set_up(state: State) -> pn.viewable.Viewable:
    """Show what a folder holds.

    Parameters
    ----------
    state : State
        Of the page.

    Returns
    -------
    Viewable
        Of Panel.
    """
    field = pn.widgets.TextInput(
        name="Folder of the measurement", value=str(state.folder or state.root), sizing_mode="stretch_width"
    )
    look = pn.widgets.Button(name="Look into it", button_type="primary", align="end")
    found = pn.Column(sizing_mode="stretch_width")

    async def show(event: object = None) -> None:
        try:
            folder = folder_within(state.root, field.value)
        except PlaceError as error:
            found[:] = [paragraph(str(error), kind="fault")]
            return
        look.disabled = True
        found[:] = [paragraph("Looking into the files ...", kind="note")]
        try:
            found[:] = await asyncio.to_thread(found_in_folder, folder)
            state.folder = folder
        finally:
            look.disabled = False

    look.on_click(show)
    pn.state.onload(show)
    return pn.Column(
        heading("Set up"), pn.Row(field, look, sizing_mode="stretch_width"), found, sizing_mode="stretch_width"
    )
