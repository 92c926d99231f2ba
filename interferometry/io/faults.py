"""What readers of files raise and list: a file that cannot be used, and a single line that was left out."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from interferometry.common import InterferometryError

if TYPE_CHECKING:
    import xarray as xr


class LaserFormatError(InterferometryError):
    """A laser or environment file that cannot be used as a whole; the message names file, place, value and remedy."""


@dataclass(frozen=True)
class RejectedLine:
    """A line (from 1) of a file (its name) that was left out: its value, and why, as a predicate of the value ("is not a number")."""

    path: str
    line: int
    value: str
    reason: str


class BadReading(InterferometryError):
    """A line that cannot be used, with the text and the reason of a `RejectedLine`."""

    def __init__(self, value: str, reason: str) -> None:
        super().__init__(f"{value!r}: {reason}")
        self.value = value
        self.reason = reason


@dataclass
class LeftOut:
    """Lines of a file that cannot be used, collected while it is read."""

    path: Path
    lines: list[RejectedLine] = field(default_factory=list)

    def add(self, line: int, value: str, reason: str) -> None:
        """Leave a line out."""
        self.lines.append(RejectedLine(self.path.name, line, value, reason))

    @contextmanager
    def collect(self, line: int) -> Iterator[None]:
        """Leave a line out where its reading raises `BadReading`."""
        try:
            yield
        except BadReading as fault:
            self.add(line, fault.value, fault.reason)

    def note_in(self, deviations: xr.Dataset) -> None:
        """Write into the attributes of deviations which file they are of, what was left out and how many readings are missing."""
        missing = int(deviations["deviation"].isnull().sum())
        deviations.attrs.update(source=self.path.name, left_out=self.as_json(), missing=missing)

    def as_json(self) -> str:
        """Return the lines for the attribute ``left_out`` of a Dataset."""
        return json.dumps([asdict(line) for line in self.lines])


def raise_if_mostly_invalid(path: Path, kept: int, left_out: list[RejectedLine], *, last: int | None = None) -> None:
    """Raise where fewer than half of the lines can be used: that is a fault of the file, not of single readings.

    Below `last`, the last line that was read, lines without a value are the end of a sheet and no fault.
    """
    if last is not None:
        left_out = [line for line in left_out if line.value.strip() or line.line < last]
    if kept == 0 and not left_out:
        raise LaserFormatError(f"{path}: no reading below the header; export the measured values again")
    if kept < len(left_out):
        first = left_out[0]
        raise LaserFormatError(
            f"{path}: {len(left_out)} of {kept + len(left_out)} lines cannot be used, the first is line {first.line}: "
            f"{first.value!r} {first.reason}; correct that column"
        )


#: More than any test has; a damaged file may give every reading a cycle and a target of its own.
MOST_CELLS = 5_000_000


def raise_if_too_many(path: Path, cycles: int, targets: int) -> None:
    """Raise where readings by cycle, direction and target would fill the memory."""
    if 2 * cycles * targets > MOST_CELLS:
        raise LaserFormatError(
            f"{path}: {cycles} cycles in 2 directions at {targets} targets are more than {MOST_CELLS:,} readings; give the readings of one "
            "cycle the same number, and every target its number in all cycles"
        )


# Numbers as instruments and spreadsheets write them: decimal comma or point, thousands, signs, marks for "no
# reading".

#: Values that instruments write for "no reading"; Renishaw's is -1e20.
SENTINEL_MAGNITUDE = 1e19
#: Minus signs of word processors and tables, and spaces that part thousands.
_SIGNS = str.maketrans({"\u2212": "-", "\u2013": "-", "\uff0d": "-", "\ufe63": "-", "\uff0b": "+"})
_SPACES = re.compile(r"[\s\u00a0\u2007\u2009\u202f'\u2019]")
_NUMBER = re.compile(r"[+-]?(\d+[\d.,]*|[.,]\d+)([eE][+-]?\d+)?")
#: What most files write, and what has one meaning where the decimal separator is a point: finite, and below any mark for "no reading".
_PLAIN = re.compile(r"[+-]?\d{1,18}(\.\d+)?")
#: A separator followed by three digits, once or more, may part thousands.
THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}([.,]\d{3})+")
#: A number whose decimal separator is told by its digits: one separator, or another one after groups of three.
_DECIMAL = re.compile(r"[+-]?(\d*|\d{1,3}(?P<group>[.,])\d{3}((?P=group)\d{3})*)(?P<decimal>[.,])\d*([eE][+-]?\d+)?")
#: 9999, -99999.999: four nines or more before the point and nothing but nines or zeros behind it.
_ALL_NINES = re.compile(r"[+-]?9{4,}([.,](9+|0+))?")


def parse_number(text: str) -> float:
    """Return a finite number written with a decimal point; 1e19 or more in magnitude is a mark for "no reading"; raises `BadReading`."""
    cleaned = text.strip().translate(_SIGNS)
    try:
        # Python reads "1_2.5" as 12.5; in a measured file it is a damaged number.
        value = float("" if "_" in cleaned else cleaned)
    except ValueError:
        raise BadReading(text, "is not a number") from None
    if not math.isfinite(value) or abs(value) >= SENTINEL_MAGNITUDE:
        raise BadReading(text, "is not a finite number")
    return value


@dataclass(frozen=True)
class Numerals:
    """How the numbers of one file are written: the decimal separator, "" where a single separator is the decimal one.

    ``examples`` are the numbers that tell it, one of each kind.
    """

    decimal: str = ""
    examples: tuple[str, ...] = ()

    @classmethod
    def of(cls, texts: Iterable[str]) -> Numerals:
        """Find the decimal separator from all fields of a file; those that are no numbers, such as dates, are passed over."""
        seen: dict[str, str] = {}
        for text in dict.fromkeys(texts):
            cleaned = _SPACES.sub("", text.translate(_SIGNS))
            match = _DECIMAL.fullmatch(cleaned) if _NUMBER.fullmatch(cleaned) else None
            if match and match["decimal"] != match["group"] and not THOUSANDS.fullmatch(cleaned):
                seen.setdefault(match["decimal"], text.strip())
        return cls(next(iter(seen)) if len(seen) == 1 else "", tuple(seen.values()))

    @classmethod
    def of_columns(cls, columns: Iterable[Iterable[str]]) -> Numerals:
        """Find it from the columns of a file: where another separator is the decimal one elsewhere, a column shows that its own parts
        thousands by a number below 1000, or one with both.
        """
        listed = [dict.fromkeys(column) for column in columns]
        whole = cls.of(text for column in listed for text in column)
        for column in listed if whole.decimal else ():
            open_ = next((text for text in column if THOUSANDS.fullmatch(text) and whole.decimal not in text), "")
            if open_ and not parts_thousands(column):
                return cls(examples=(*whole.examples, open_))
        return whole

    def number(self, text: str) -> float:
        """Return a finite number."""
        if self.decimal == "." and _PLAIN.fullmatch(text):
            return float(text)
        cleaned = _SPACES.sub("", text.strip().translate(_SIGNS))
        if not _NUMBER.fullmatch(cleaned):
            return parse_number(text)
        if not self.decimal and self.examples and THOUSANDS.fullmatch(cleaned):
            both = " and ".join(map(repr, self.examples))
            raise BadReading(
                text, f"may part thousands or decimals, as the file has {both}; write one decimal separator"
            )
        decimal = self.decimal or max(".,", key=cleaned.rfind)
        other = "," if decimal == "." else "."
        whole = cleaned.replace(other, "") if not self.decimal or _groups(cleaned, other) else cleaned
        return parse_number(whole.replace(decimal, "."))

    def reading(self, text: str) -> float:
        """Return a measured value: as `number`, but nothing except nines is a mark for "no reading"."""
        if text.count("9") >= 4 and _ALL_NINES.fullmatch(_SPACES.sub("", text.strip().translate(_SIGNS))):
            raise BadReading(text, "consists of nines only, a mark for no reading")
        return self.number(text)


def parts_thousands(texts: Iterable[str]) -> bool:
    """Return whether numbers of which some may part thousands show it: by a whole one below 1000, or one with two separators."""
    return any(
        (text.isdecimal() and len(text) < 4) or len(re.split("[.,]", text)) > 2
        for text in texts
        if _NUMBER.fullmatch(text)
    )


def _groups(cleaned: str, separator: str) -> bool:
    """Return whether a separator parts groups of three digits before the decimal separator."""
    head = re.split(r"[eE]", cleaned)[0]
    return re.fullmatch(rf"[+-]?\d{{1,3}}(\{separator}\d{{3}})+([.,]\d*)?", head) is not None
