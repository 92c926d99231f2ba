"""Parts of a screen that show text: whatever comes from a file is shown as text and never as markup."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import panel as pn

from fusion.terminal import printable


def as_markup(text: str) -> str:
    """Return a text as markup in which nothing is an element, nor turns the direction of what stands beside it.

    Parameters
    ----------
    text : str
        From a file.
    """
    return escape(printable(text))


def heading(text: str, *, level: int = 2) -> pn.pane.HTML:
    """Return a heading.

    Parameters
    ----------
    text : str
        Shown as it is.
    level : int
        2 for the title of a screen, 3 for a part of it.
    """
    return pn.pane.HTML(f"<h{level}>{as_markup(text)}</h{level}>", sizing_mode="stretch_width")


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
    return f'<p class="{as_markup(kind)}"{role}>{as_markup(text)}</p>'


def bullets(lines: Iterable[str]) -> pn.pane.HTML:
    """Return a list.

    Parameters
    ----------
    lines : iterable of str
        Shown as they are.
    """
    items = "".join(f"<li>{as_markup(line)}</li>" for line in lines)
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
    head = "".join(f'<th scope="col">{as_markup(name)}</th>' for name in columns)
    body = "".join(
        f'<tr><th scope="row">{as_markup(first)}</th>{"".join(f"<td>{as_markup(cell)}</td>" for cell in rest)}</tr>'
        for first, *rest in rows
    )
    kind = ' class="stacked"' if stacked else ""
    return pn.pane.HTML(
        f'<div class="scroll" tabindex="0" role="region" aria-label="{as_markup(caption)}"><table{kind}>'
        f"<caption>{as_markup(caption)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>",
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
        f'<p><a href="{as_markup(address)}" target="_blank" rel="noopener">{as_markup(text)}</a></p>',
        sizing_mode="stretch_width",
    )
