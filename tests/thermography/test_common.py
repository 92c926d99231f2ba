"""Tables for spreadsheets: no text of them is a formula or acts, numbers stay numbers."""

import csv

import numpy as np
import pandas as pd
import pytest

from thermography.common import spreadsheet_text, write_csv


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("=cmd|' /C calc'!A0", "'=cmd|' /C calc'!A0"),
        ("\t=1+1", "'\t=1+1"),
        ("＝1+1", "'＝1+1"),
        ("@x", "'@x"),
        ("a\x1b[31m\x07\u202eb", "a [31m  b"),
        ("\r=1", " =1"),
        ("T1 = 5, 'q' \"q\", 🌡\u200d Größe", "T1 = 5, 'q' \"q\", 🌡\u200d Größe"),
    ],
)
def test_a_text_begins_no_formula_and_moves_no_cursor(text, shown):
    assert spreadsheet_text(text) == shown


def test_a_table_keeps_its_numbers_and_columns_of_one_name(tmp_path):
    columns = ["=1", "a", "a", "time"]
    table = pd.DataFrame([[-1.5, "-x", 1, np.datetime64("2026-03-09", "ns")], [np.nan, "y", 2, None]], columns=columns)
    before = table.copy()
    assert write_csv(table, tmp_path / "t.csv") is None
    rows = list(csv.reader((tmp_path / "t.csv").read_text().splitlines()))
    assert rows == [["'=1", "a", "a", "time"], ["-1.5", "'-x", "1", "2026-03-09T00:00:00.000000Z"], ["", "y", "2", ""]]
    pd.testing.assert_frame_equal(table, before)
