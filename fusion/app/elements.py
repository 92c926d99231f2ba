"""Parts of a screen that show text: whatever comes from a file is shown as text and never as markup."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import panel as pn


def heading(text: str, *, level: int = 2) -> pn.pane.HTML:
    """Return a heading.

    Parameters
    ----------
    text : str
        Shown as it is.
    level : int
        2 for the title of a screen, 3 for a part of it.
    """
    return pn.pane.HTML(f"<h{level}>{escape(text)}</h{level}>", sizing_mode="stretch_width")


def paragraph(text: str, *, kind: str = "") -> pn.pane.HTML:
    """Return a paragraph.

    Parameters
    ----------
    text : str
        Shown as it is.
    kind : str
        "note" for small print, "warning" or "fault" for a message that asks for action, "done" for a success; these three are read
        aloud when they come.
    """
    return pn.pane.HTML(paragraph_markup(text, kind=kind), sizing_mode="stretch_width")


def paragraph_markup(text: str, *, kind: str = "") -> str:
    """Return a paragraph as markup, for a pane whose text changes.

    Parameters
    ----------
    text : str
        Shown as it is; nothing gives no paragraph.
    kind : str
        As for `paragraph`.
    """
    if not text:
        return ""
    role = {"fault": ' role="alert"', "warning": ' role="status"', "done": ' role="status"'}.get(kind, "")
    return f'<p class="{escape(kind)}"{role}>{escape(text)}</p>'


def bullets(lines: Iterable[str]) -> pn.pane.HTML:
    """Return a list.

    Parameters
    ----------
    lines : iterable of str
        Shown as they are.
    """
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return pn.pane.HTML(f"<ul>{items}</ul>", sizing_mode="stretch_width")


def table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], *, caption: str, stacked: bool = False
) -> pn.pane.HTML:
    """Return a table whose first column names its rows.

    Parameters
    ----------
    columns : sequence of str
        Headings.
    rows : iterable of sequence of str
        A text per column.
    caption : str
        What the table shows.
    stacked : bool
        Whether the cells of a row stand below one another on a phone: for cells that hold sentences.
    """
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in columns)
    body = "".join(
        f'<tr><th scope="row">{escape(first)}</th>{"".join(f"<td>{escape(cell)}</td>" for cell in rest)}</tr>'
        for first, *rest in rows
    )
    kind = ' class="stacked"' if stacked else ""
    return pn.pane.HTML(
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(caption)}"><table{kind}>'
        f"<caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>",
        sizing_mode="stretch_width",
    )


def link(text: str, address: str) -> pn.pane.HTML:
    """Return a link that opens in a tab of its own.

    Parameters
    ----------
    text : str
        Shown as it is.
    address : str
        Within the application.
    """
    return pn.pane.HTML(
        f'<p><a href="{escape(address)}" target="_blank" rel="noopener">{escape(text)}</a></p>',
        sizing_mode="stretch_width",
    )
