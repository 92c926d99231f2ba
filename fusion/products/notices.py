"""What was left out of a file, counted and named."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import TYPE_CHECKING

from fusion.products.results import Notice

if TYPE_CHECKING:
    import xarray as xr

#: Maximum number of omitted items listed in a message; the products hold all of them.
_NAMED = 5


def left_out_notices(dataset: xr.Dataset, code: str) -> list[Notice]:
    """Return one notice for each file that counts its rejected lines and lists the first of them.

    Parameters
    ----------
    dataset : Dataset
        Table whose attribute ``left_out`` lists the rejected lines as JSON.
    code : str
        Code of the notice.
    """
    lines = json.loads(dataset.attrs.get("left_out", "[]"))
    notices = []
    for path in dict.fromkeys(item["path"] for item in lines):
        named = [f"line {item['line']} ({item['value']!r} {item['reason']})" for item in lines if item["path"] == path]
        notices.append(
            Notice(
                code,
                f"{counted(len(named), 'line')} of {path} left out: {listed(named)}.",
                f"Correct these lines in {path} and run again; the estimates allow for the gaps.",
            )
        )
    return notices


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, plural unless the number is 1.

    Parameters
    ----------
    number : int
        How many.
    noun : str
        In the singular.
    """
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def listed(names: Iterable[str]) -> str:
    """Return the first names, and how many more there are.

    Parameters
    ----------
    names : iterable of str
        All of them; the first five are listed.
    """
    names = list(names)
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return "; ".join(names[:_NAMED]) + more
