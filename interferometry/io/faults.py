"""What readers of files raise and list: a file that cannot be used, and a single line that was left out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from interferometry.errors import InterferometryError


class LaserFormatError(InterferometryError):
    """A laser or environment file that cannot be used as a whole; the message names file, place, value and remedy."""


@dataclass(frozen=True)
class RejectedLine:
    """One line of a file that was left out.

    Attributes
    ----------
    path : str
        Name of the file.
    line : int
        Its number, from 1.
    value : str
        The text that could not be used.
    reason : str
        Why, as the predicate of a sentence about the value ("is not a number").
    """

    path: str
    line: int
    value: str
    reason: str


class BadReading(InterferometryError):
    """A line that cannot be used; it is caught by the reader, which lists the line as a `RejectedLine`.

    Parameters
    ----------
    value : str
        The text that could not be used.
    reason : str
        Why, as the predicate of a sentence about the value.
    """

    def __init__(self, value: str, reason: str) -> None:
        super().__init__(f"{value!r}: {reason}")
        self.value = value
        self.reason = reason


def unreadable_spreadsheet(path: Path, fault: object) -> LaserFormatError:
    """Return the error of a spreadsheet that its reader, or the look into it beforehand, cannot take.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    fault : object
        What is wrong, as text or exception.
    """
    return LaserFormatError(
        f"{path}: cannot be read as a spreadsheet ({fault}); open it, remove a password if it has one, and save it again as XLSX"
    )


def raise_if_mostly_invalid(path: Path, kept: int, left_out: list[RejectedLine]) -> None:
    """Raise where fewer than half of the lines can be used: that is a fault of the file, not of single readings.

    Parameters
    ----------
    path : pathlib.Path
        For the message.
    kept : int
        Number of lines that can be used.
    left_out : list of RejectedLine
        Those that cannot.

    Raises
    ------
    LaserFormatError
        There are no lines, or more lines were left out than kept.
    """
    if kept == 0 and not left_out:
        raise LaserFormatError(f"{path}: no reading below the header; export the measured values again")
    if kept < len(left_out):
        first = left_out[0]
        raise LaserFormatError(
            f"{path}: {len(left_out)} of {kept + len(left_out)} lines cannot be used, the first is line {first.line}: "
            f"{first.value!r} {first.reason}; correct that column"
        )
