"""The fields of a campaign file as widgets."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import panel as pn

from fusion.app.elements import heading
from fusion.app.setup.campaign_text import CampaignText
from fusion.app.setup.fields import FIELDS, read_fields

_GROUPS = {
    ("campaign",): "Test",
    ("thermography",): "Camera",
    ("plan",): "Plan",
    ("plan", "axis"): "Axis on the plan",
    ("interferometry",): "Laser",
    ("report",): "Report",
}


class Form:
    """Fields of a campaign file, in groups by table.

    Parameters
    ----------
    on_change : callable
        Takes the name of a field whose text has changed.
    """

    def __init__(self, on_change: Callable[[str], None]) -> None:
        self._on_change = on_change
        self._widgets: dict[str, pn.widgets.Widget] = {}
        self.view = pn.Column(sizing_mode="stretch_width")

    def show(self, campaign: CampaignText) -> None:
        """Show the fields that a campaign file has.

        Parameters
        ----------
        campaign : CampaignText
            Opened file.
        """
        texts = read_fields(campaign)
        self._widgets = {}
        parts = []
        for table, title in _GROUPS.items():
            group = []
            for field in FIELDS:
                if field.table != table or field.name not in texts:
                    continue
                if field.options:
                    widget = pn.widgets.Select(
                        label=field.label, options=list(field.options), value=texts[field.name], width=250
                    )
                else:
                    widget = pn.widgets.TextInput(
                        label=field.label, value=texts[field.name], placeholder=field.hint, width=250
                    )
                widget.param.watch(lambda event, name=field.name: self._on_change(name), "value")
                self._widgets[field.name] = widget
                group.append(widget)
            if group:
                parts += [heading(title, level=3), pn.FlexBox(*group)]
        self.view[:] = parts

    @property
    def texts(self) -> dict[str, str]:
        """Present texts by name of the field."""
        return {name: str(widget.value) for name, widget in self._widgets.items()}

    def write(self, texts: Mapping[str, str]) -> None:
        """Write texts into fields, where the campaign file has them.

        Parameters
        ----------
        texts : mapping of str to str
            By name of the field.
        """
        for name, text in texts.items():
            if name in self._widgets:
                self._widgets[name].value = text
