"""What was left out is counted, and the first of it named."""

import json

import xarray as xr

from fusion.products.notices import counted, left_out_notices, listed


def test_numbers_and_lists_are_words() -> None:
    assert (counted(1, "frame"), counted(0, "frame")) == ("1 frame", "0 frames")
    assert listed("abc") == "a; b; c"
    assert listed(str(k) for k in range(7)) == "0; 1; 2; 3; 4 and 2 more"


def test_each_file_has_one_notice_of_its_rejected_lines() -> None:
    lines = [
        {"path": path, "line": line, "value": "x", "reason": "is no number"}
        for path, line in (("a.csv", 3), ("a.csv", 4), ("b.csv", 2))
    ]
    first, second = left_out_notices(xr.Dataset(attrs={"left_out": json.dumps(lines)}), "lines_left_out")
    assert first.message == "2 lines of a.csv left out: line 3 ('x' is no number); line 4 ('x' is no number)."
    assert second.message == "1 line of b.csv left out: line 2 ('x' is no number)."
    assert (first.code, second.remedy[:28]) == ("lines_left_out", "Correct these lines in b.csv")
    assert left_out_notices(xr.Dataset(), "lines_left_out") == []
