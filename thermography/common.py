"""What the whole package shares: its error, the contract of its products, texts of tables, and a robust scatter; light to import."""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING, Any, TypeAlias

from thermofuse.resources import variables

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd
    from numpy.typing import ArrayLike, NDArray

Array: TypeAlias = "NDArray[Any]"


ZERO_CELSIUS_K = 273.15
#: Standard deviation of a normal distribution over its median absolute deviation, to five digits. The exact 1 / 0.67449 (as SciPy's
#: ``median_abs_deviation(..., scale="normal")`` has it) differs by 1.5e-6 and would change the last digits of stored results.
MAD_TO_SIGMA = 1.4826


def usable_processors() -> int:
    """Return how many processors this process may use: where it is bound to some, these alone."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


#: Median absolute deviation of a standard normal distribution.
_NORMAL_MEDIAN = 0.6744897501960817


def scatter_by_median(values: ArrayLike, *, centre: float | None = None) -> float:
    """Standard deviation of normal values by their median absolute deviation, which up to half of them cannot spoil."""
    import numpy as np

    known = np.asarray(values, float)
    known = known[~np.isnan(known)]
    if known.size == 0:
        return float("nan")
    about = np.median(known) if centre is None else centre
    return float(np.median(np.abs(known - about))) / _NORMAL_MEDIAN


#: Characters that move the cursor, colour, rename or clear a terminal (C0 but for tab and line feed, DEL, C1), turn the direction of what
#: follows, end a line without being seen to, or are half of a character (bytes of a file name that are no text).
ACTING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
#: Signs with which formulas of a spreadsheet begin, full-width ones too (OWASP, "CSV injection").
_FORMULA = ("=", "+", "-", "@", "\t", "\n", "＝", "＋", "－", "＠")


def spreadsheet_text(text: str) -> str:
    """Return a text as a table for spreadsheets holds it: nothing in it acts, and an apostrophe stands before what begins a formula."""
    shown = ACTING.sub(" ", text)
    return f"'{shown}" if shown.startswith(_FORMULA) else shown


def write_csv(frame: pd.DataFrame, path: Path | None = None, **options: Any) -> str | None:
    """Write a table as CSV without its index, or return it, with times in UTC; no heading and no text of it is a formula."""

    def safe(value: object) -> object:
        return spreadsheet_text(value) if isinstance(value, str) else value

    texts = {at: column.map(safe) for at, (_, column) in enumerate(frame.items()) if column.dtype.kind not in "biufcmM"}
    shown = frame.copy(deep=False)
    for at, column in texts.items():
        shown.isetitem(at, column.array)
    shown.columns = [safe(name) for name in frame.columns]
    return shown.to_csv(path, index=False, date_format="%Y-%m-%dT%H:%M:%S.%fZ", **options)


#: Contract of fields on the table plan, on which other packages rely, and the attributes of their variables; ``x`` and ``y`` are in mm,
#: ``cycle`` counts from 1.
FIELDS, FIELD_ATTRIBUTES = variables("fields")


class ThermographyError(ValueError):
    """Input that cannot be used; the message names the place, the value and the remedy.

    Every error that this package raises about its input is a subclass, so that a caller recognises all of them by class.
    """
