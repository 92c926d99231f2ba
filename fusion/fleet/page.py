"""The page of a fleet: what failed and why, then one row per campaign with a link to its report."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from urllib.parse import quote

from fusion.fleet.summary import HEADINGS, TEXT, Row, cells, count_line
from fusion.report.page import render_page


def render_fleet(rows: Sequence[Row], *, started: str) -> str:
    """Return the page of a fleet as HTML text.

    Parameters
    ----------
    rows : sequence of Row
        One per campaign.
    started : str
        When the fleet was started, ISO 8601, UTC.

    Returns
    -------
    str
        One HTML page that needs no other file and no network; links lead to the reports beside it.
    """
    return render_page(
        "fleet.html.j2",
        {},
        counts=count_line(rows),
        started=f"{datetime.fromisoformat(started):%Y-%m-%d %H:%M} UTC",
        headings=[(heading[0].upper() + heading[1:], heading not in TEXT) for heading in HEADINGS],
        rows=[(row, quote(row.report), cells(row)[1:]) for row in rows],
        failed=[(row, quote(row.log)) for row in rows if row.state == "failed"],
        summary={"premises": {}},
    )
