"""The terminal: text from files is shown as it is, and none of it acts on the terminal."""

from __future__ import annotations

import codecs
import json
import re
import sys
from collections.abc import Callable, Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.segment import Segment
from rich.text import Text

#: Characters that move the cursor, colour, rename or clear a terminal (C0 but for tab and line feed, DEL, C1), turn the direction of what
#: follows, end a line without being seen to, or are half of a character (bytes of a file name that are no text).
_ACTING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_BEYOND_ASCII = re.compile("[^\x00-\x7f]+")
#: Longer lines, and more of them, are cut: a message that names what somebody put into a file is read by people.
_LONGEST_LINE, _MOST_LINES = 4_000, 2_000


def printable(text: str) -> str:
    r"""Return a text in which nothing acts on a terminal: such characters are written as in Python, ``\x1b``.

    Parameters
    ----------
    text : str
        With names, titles and values from files.

    Notes
    -----
    Control functions of ECMA-48; direction of text by Unicode Standard Annex 9.

    Examples
    --------
    >>> print(printable("axis \x1b[2J"))
    axis \x1b[2J
    """
    return _ACTING.sub(lambda found: repr(found.group())[1:-1], text)


def printable_json(text: str) -> str:
    r"""Return JSON in which nothing acts on a terminal: the same values, such characters written as ``\u009b``.

    Parameters
    ----------
    text : str
        JSON over any number of lines.
    """
    return _ACTING.sub(lambda found: f"\\u{ord(found.group()):04x}", text)


def ascii_json(text: str) -> str:
    r"""Return JSON of ASCII alone: the same values, other characters written as ``\u00b5``.

    Parameters
    ----------
    text : str
        JSON over any number of lines.
    """
    return _BEYOND_ASCII.sub(lambda found: json.dumps(found.group())[1:-1], text)


def print_json(content: object, told: Callable[[str], str] = str) -> None:
    """Print JSON for other programs, in the encoding of the output or in ASCII.

    Parameters
    ----------
    content : object
        What JSON can hold.
    told : callable
        Puts in the address of what was fetched.
    """
    text = told(printable_json(json.dumps(content, indent=1, ensure_ascii=False)))
    in_utf8 = codecs.lookup(sys.stdout.encoding or "utf-8").name == "utf-8"
    sys.stdout.write((text if in_utf8 else ascii_json(text)) + "\n")


def cell(text: str) -> str:
    """Return a text as cells and titles of tables take it, where markup would be read.

    Parameters
    ----------
    text : str
        With names and titles from files.
    """
    return escape(printable(text))


def short(text: str) -> str:
    """Return a text whose lines, and their number, somebody can read; what is left out is counted.

    Parameters
    ----------
    text : str
        Message of any length.
    """
    lines = text.split("\n", _MOST_LINES)
    if len(lines) > _MOST_LINES:
        lines[-1] = f"... and {lines[-1].count(chr(10)) + 1} more lines"
    half = _LONGEST_LINE // 2
    return "\n".join(
        line
        if len(line) <= _LONGEST_LINE
        else f"{line[:half]} ... {len(line) - 2 * half} characters left out ... {line[-half:]}"
        for line in lines
    )


class Terminal(Console):
    """A console of which text is no markup, has no marks for pictures, and does not act on the terminal."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as `rich.console.Console.print` does; text as it is, and short enough to be read."""
        super().print(*(Text(short(printable(one))) if isinstance(one, str) else one for one in objects), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the parts of what is printed, the cells of tables among them."""
        for part in super().render(renderable, options):
            yield part if part.control else Segment(printable(part.text), part.style)
