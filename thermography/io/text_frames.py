"""Frames of temperatures as text: one number per pixel, one line per row, as the programs of most cameras export them."""

from __future__ import annotations

import codecs
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermography.errors import ThermographyError
from thermography.io.temperature_frames import StackContents, StackOptions, TemperatureReader

_DELIMITERS = (";", "\t", ",", " ")
#: Fewest rows and columns of a frame: a table with a few columns is none.
_FEWEST = 8
#: Largest share of the pixels of a frame that hold no number: with more it is a table with words.
_MOST_MISSING = 0.25
#: Largest ratio of the sides of a frame: a log of a few columns over many lines is none.
_LONGEST = 4
#: A text frame of a large camera has about 10 MB.
_MOST_BYTES = 1 << 28
#: No sensor has more columns, or with the lines around its numbers more lines: a longer table is no frame, and is not read to see that.
_MOST_COLUMNS, _MOST_LINES = 16_384, 131_072


class TextReader(TemperatureReader):
    """Reader of one frame per file as CSV or TSV: the longest block of lines with equally many numbers; lines around it are passed over."""

    name = "text with one temperature per pixel"

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file is text.

        Parameters
        ----------
        path : Path
        start : bytes
            Its first bytes.
        """
        marked = start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        return bool(start) and (marked or not set(start) & (set(range(32)) - {9, 10, 12, 13, 27}))

    def holds_a_frame(self, path: Path) -> bool:
        """Return whether a text file holds a block of numbers.

        Parameters
        ----------
        path : Path
        """
        try:
            self.contents(path, StackOptions())
        except ThermographyError:
            return False
        return True

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a file holds.

        Parameters
        ----------
        path : Path
        options : StackOptions

        Raises
        ------
        ThermographyError
            The file holds no block of numbers.
        """
        values = self.read_values(path, 0, options)
        return StackContents(1, (values.shape[0], values.shape[1]))

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the numbers of a file, (row, column); NaN where a field is no number.

        Parameters
        ----------
        path : Path
        index : int
            Not used: a file holds one frame.
        options : StackOptions

        Raises
        ------
        ThermographyError
            The file holds no block of numbers.
        """
        if path.stat().st_size > _MOST_BYTES:
            raise ThermographyError(
                f"{path}: {path.stat().st_size} bytes of text are more than a frame; export every frame alone"
            )
        content = path.read_bytes()
        utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        lines = content.decode("utf-16" if utf16 else "utf-8-sig", errors="replace").splitlines()
        for delimiter in _DELIMITERS if len(lines) <= _MOST_LINES else ():
            block = _longest_block(lines, delimiter)
            if _is_a_frame(block):
                return np.array(block)
        raise ThermographyError(
            f"{path}: no block of at least {_FEWEST} x {_FEWEST} numbers in the proportions of a sensor; "
            "export the temperatures of the frame as CSV, one line per row"
        )


def _is_a_frame(block: list[list[float]]) -> bool:
    rows, columns = len(block), len(block[0]) if block else 0
    if min(rows, columns) < _FEWEST or max(rows, columns) > _LONGEST * min(rows, columns):
        return False
    return bool(np.isnan(block).mean() <= _MOST_MISSING)


def _longest_block(lines: list[str], delimiter: str) -> list[list[float]]:
    """Return the longest run of lines that hold the same number of numbers."""
    best: list[list[float]] = []
    block: list[list[float]] = []
    for line in lines:
        row = _numbers(line, delimiter)
        if block and (row is None or len(row) != len(block[0])):
            best, block = max(best, block, key=len), []
        if row is not None:
            block.append(row)
    return max(best, block, key=len)


def _numbers(line: str, delimiter: str) -> list[float] | None:
    """Return the numbers of a line, NaN for a field that is empty or a word for none; None where the line is no row of a frame."""
    fields = line.split() if delimiter == " " else line.rstrip().removesuffix(delimiter).split(delimiter)
    if not _FEWEST <= len(fields) <= _MOST_COLUMNS:
        return None
    if delimiter != ",":
        fields = [field.replace(",", ".") for field in fields]
    try:
        return [float(field) for field in fields]
    except ValueError:
        values = [_number(field) for field in fields]
        # A row may lack single pixels; a heading lacks most.
        return values if 2 * np.isnan(values).sum() < len(values) else None


def _number(field: str) -> float:
    try:
        return float(field) if "_" not in field else np.nan
    except ValueError:
        return float("nan")
