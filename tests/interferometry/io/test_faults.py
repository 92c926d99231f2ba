"""When a whole file is refused because too many of its lines cannot be used."""

from __future__ import annotations

from pathlib import Path

import pytest

from interferometry.io.faults import LaserFormatError, RejectedLine, raise_if_mostly_invalid

PATH = Path("t.csv")


def test_a_file_is_refused_when_fewer_than_half_of_its_lines_can_be_used() -> None:
    line = RejectedLine("t.csv", 3, "x", "is not a number")
    raise_if_mostly_invalid(PATH, 2, [line, line])
    with pytest.raises(LaserFormatError, match="2 of 3 lines cannot be used, the first is line 3: 'x' is not a number"):
        raise_if_mostly_invalid(PATH, 1, [line, line])
    with pytest.raises(LaserFormatError, match="no reading below the header"):
        raise_if_mostly_invalid(PATH, 0, [])
