"""Bytes to text: the encodings of spreadsheet programs, and what is no text."""

from __future__ import annotations

from pathlib import Path

import pytest

from interferometry.io.encodings import decode_text
from interferometry.io.faults import LaserFormatError

PATH = Path("t.csv")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252", "latin-1"])
def test_western_text_is_read_in_every_usual_encoding(encoding: str) -> None:
    text = "Zyklus;Abweichung [µm];Größe\n1;0,64;2\n"
    assert decode_text(PATH, text.encode(encoding), chinese_words=("偏差",)) == text


def test_the_chinese_code_page_is_recognised_by_its_words() -> None:
    text = "循环,方向,位置(mm),偏差(μm)\n"
    assert decode_text(PATH, text.encode("gb18030"), chinese_words=("偏差",)) == text


def test_bytes_without_meaning_in_the_code_page_are_kept() -> None:
    assert decode_text(PATH, b"a\x81b") == "a\x81b"


def test_what_is_no_text_is_refused_with_its_place() -> None:
    with pytest.raises(
        LaserFormatError, match="character 3 is a zero byte, so the file is not text; save the table as CSV"
    ):
        decode_text(PATH, b"ab\0c")
    with pytest.raises(
        LaserFormatError, match=r"byte \d+ is not text in UTF-16, as which the file begins; it is damaged"
    ):
        decode_text(PATH, "abc".encode("utf-16") + b"\xd8")
