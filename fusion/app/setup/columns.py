"""The columns of a record on the screen *Set up*: first values, role and unit of each, as `thermofuse init` proposes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import panel as pn

from fusion.app.parts import beside, column, heading, note, table
from fusion.campaign.columns import ROLES, TableProposal
from fusion.results.progress import counted


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
