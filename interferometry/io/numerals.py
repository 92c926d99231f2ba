"""Numbers as instruments and spreadsheets write them: decimal comma or point, thousands, signs, marks for "no reading"."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

from interferometry.io.faults import BadReading

#: Values that instruments write for "no reading"; Renishaw's is -1e20.
SENTINEL_MAGNITUDE = 1e19
#: Minus signs of word processors and tables, and spaces that part thousands.
_SIGNS = str.maketrans({"\u2212": "-", "\u2013": "-", "\uff0d": "-", "\ufe63": "-", "\uff0b": "+"})
_SPACES = re.compile(r"[\s\u00a0\u2007\u2009\u202f']")
_NUMBER = re.compile(r"[+-]?(\d+[\d.,]*|[.,]\d+)([eE][+-]?\d+)?")
#: A separator followed by three digits, once or more, may part thousands.
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}([.,]\d{3})+")
#: 9999, -99999.999: four nines or more before the point and nothing but nines or zeros behind it.
_ALL_NINES = re.compile(r"[+-]?9{4,}([.,](9+|0+))?")


def parse_number(text: str) -> float:
    """Return a number written with a decimal point, as programs of instruments write it.

    Parameters
    ----------
    text : str

    Returns
    -------
    float
        Finite.

    Raises
    ------
    BadReading
        The text is no finite number, or it is a mark for "no reading" (1e19 or more in magnitude).

    Examples
    --------
    >>> parse_number("−1.25")
    -1.25
    """
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
    """How the numbers of one file are written.

    Attributes
    ----------
    decimal : {"", ",", "."}
        The decimal separator; "" where the file does not settle it: then a single separator is the decimal one.
    """

    decimal: str = ""

    @classmethod
    def of(cls, texts: Iterable[str]) -> Numerals:
        """Find the decimal separator from all numbers of a file.

        Parameters
        ----------
        texts : iterable of str
            Its fields; those that are no numbers are passed over.

        Returns
        -------
        Numerals

        Examples
        --------
        >>> Numerals.of(["1.000", "0,64"]).number("1.000")
        1000.0
        """
        seen = set()
        for text in texts:
            cleaned = _SPACES.sub("", text.translate(_SIGNS))
            if _NUMBER.fullmatch(cleaned) and not _THOUSANDS.fullmatch(cleaned):
                seen |= {max(".,", key=cleaned.rfind)} if ("." in cleaned or "," in cleaned) else set()
        return cls(seen.pop() if len(seen) == 1 else "")

    def number(self, text: str) -> float:
        """Return a finite number.

        Parameters
        ----------
        text : str

        Raises
        ------
        BadReading
            The text is no number.
        """
        cleaned = _SPACES.sub("", text.strip().translate(_SIGNS))
        if not _NUMBER.fullmatch(cleaned):
            return parse_number(text)
        decimal = self.decimal or max(".,", key=cleaned.rfind)
        other = "," if decimal == "." else "."
        whole = cleaned.replace(other, "") if not self.decimal or _groups(cleaned, other) else cleaned
        return parse_number(whole.replace(decimal, "."))

    def reading(self, text: str) -> float:
        """Return a measured value: as `number`, but nothing except nines is a mark for "no reading".

        Parameters
        ----------
        text : str

        Raises
        ------
        BadReading
            The text is no number, or such a mark.
        """
        if _ALL_NINES.fullmatch(_SPACES.sub("", text.strip().translate(_SIGNS))):
            raise BadReading(text, "is nothing but nines, a mark for no reading")
        return self.number(text)


def _groups(cleaned: str, separator: str) -> bool:
    """Return whether a separator parts groups of three digits before the decimal separator."""
    head = re.split(r"[eE]", cleaned)[0]
    return re.fullmatch(rf"[+-]?\d{{1,3}}(\{separator}\d{{3}})+([.,]\d*)?", head) is not None
