"""Regions of the table with an emissivity of their own, as a list that is added to and taken from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import panel as pn

from fusion.app.elements import heading, paragraph_markup
from fusion.app.setup.plan_view import region_table

_CORNERS = ("x of one corner (mm)", "y of one corner (mm)", "x of the other (mm)", "y of the other (mm)")


class RegionsView:
    """Emissivity regions.

    Parameters
    ----------
    on_change : callable
        Called whenever the regions have changed.

    Attributes
    ----------
    regions : list of dict
        As the campaign file writes them.
    """

    def __init__(self, on_change: Callable[[], None]) -> None:
        self.regions: list[dict[str, Any]] = []
        self._changed = on_change
        self._name = pn.widgets.TextInput(label="Name of the region", width=190)
        self._emissivity = pn.widgets.TextInput(label="Its emissivity", placeholder="0.35 +- 0.05", width=190)
        self._corners = [pn.widgets.FloatInput(label=label, width=170, step=1.0) for label in _CORNERS]
        self._chosen = pn.widgets.Select(label="Regions", options=[], width=190)
        self._told = pn.pane.HTML("", sizing_mode="stretch_width")
        add, remove = pn.widgets.Button(label="Add the region"), pn.widgets.Button(label="Remove the region")
        add.on_click(self._add)
        remove.on_click(self._remove)
        self.view = pn.Column(
            heading("Emissivity regions", level=3),
            pn.FlexBox(self._name, self._emissivity, *self._corners, add),
            pn.FlexBox(self._chosen, remove),
            self._told,
            sizing_mode="stretch_width",
        )

    def show(self, regions: list[dict[str, Any]]) -> None:
        """Show regions.

        Parameters
        ----------
        regions : list of dict
            As the campaign file writes them.
        """
        self.regions = regions
        names = [str(one.get("name", "")) for one in regions]
        self._chosen.param.update(options=names, value=names[-1] if names else None)

    def take_corners(self, one: tuple[float, float], other: tuple[float, float]) -> None:
        """Take the corners of a drawn rectangle.

        Parameters
        ----------
        one, other : tuple of float, mm
            Opposite corners.
        """
        for field, value in zip(self._corners, (*one, *other), strict=True):
            field.value = round(value, 1)
        told = "The corners are taken; give the region a name and its emissivity, then add it."
        self._told.object = paragraph_markup(told, kind="done")

    def _add(self, event: object) -> None:
        corners = [field.value for field in self._corners]
        name, emissivity = self._name.value.strip(), self._emissivity.value.strip()
        taken = name in [one.get("name") for one in self.regions]
        if not name or not emissivity or taken or any(value is None for value in corners):
            told = (
                "A region needs a name of its own, an emissivity such as 0.35 +- 0.05, and two opposite corners in mm."
            )
            self._told.object = paragraph_markup(told, kind="fault")
            return
        x0, y0, x1, y1 = (float(value) for value in corners)
        self.show([*self.regions, region_table(name, emissivity, [(x0, y0), (x1, y1)])])
        self._told.object = ""
        self._name.value = self._emissivity.value = ""
        self._changed()

    def _remove(self, event: object) -> None:
        self.show([one for one in self.regions if one.get("name") != self._chosen.value])
        self._changed()
