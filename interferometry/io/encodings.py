"""Bytes of a text file to text: UTF-8, UTF-16, the code page of Western Windows, and that of Chinese Windows."""

from __future__ import annotations

import codecs
from collections.abc import Iterable
from pathlib import Path

from interferometry.io.faults import LaserFormatError

_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def decode_text(path: Path, content: bytes, *, chinese_words: Iterable[str] = ()) -> str:
    """Return the text of a file, whatever a spreadsheet program of the last thirty years saved it as.

    Parameters
    ----------
    path : pathlib.Path
        For the message.
    content : bytes
        The whole file.
    chinese_words : iterable of str, optional
        Words by which text in the Chinese code page is told from Western text: every Western text can be read as Chinese too.

    Returns
    -------
    str
        Without byte-order mark.

    Raises
    ------
    LaserFormatError
        The bytes are no text.

    Examples
    --------
    >>> decode_text(Path("a.csv"), "Abweichung [µm]".encode("cp1252"))
    'Abweichung [µm]'
    """
    encoding = next((name for mark, name in _MARKS if content.startswith(mark)), None) or _unmarked_utf16(content)
    try:
        text = content.decode(encoding or "utf-8")
    except UnicodeDecodeError as fault:
        if encoding is not None:
            raise LaserFormatError(
                f"{path}: byte {fault.start} is not text in {encoding.upper()}, as which the file begins; it is damaged, copy it again"
            ) from None
        text = _in_a_code_page(content, chinese_words)
    place = text.find("\0")
    if place >= 0:
        raise LaserFormatError(
            f"{path}: character {place + 1} is a zero byte, so the file is not text; save the table as CSV in UTF-8 or as XLSX"
        )
    return text


def _unmarked_utf16(content: bytes) -> str | None:
    """Return the byte order of UTF-16 without a mark: every other byte of Western text is zero there."""
    start = content[:400]
    if len(start) < 16:
        return None
    even, odd = start[0::2].count(0), start[1::2].count(0)
    if odd > 0.4 * len(start) / 2 and even == 0:
        return "utf-16-le"
    return "utf-16-be" if even > 0.4 * len(start) / 2 and odd == 0 else None


def _in_a_code_page(content: bytes, chinese_words: Iterable[str]) -> str:
    try:
        chinese = content.decode("gb18030")
    except UnicodeDecodeError:
        chinese = ""
    if any(word in chinese for word in chinese_words):
        return chinese
    try:
        return content.decode("cp1252")
    except UnicodeDecodeError:
        # Five bytes have no meaning in the code page; Latin-1 gives every byte one.
        return content.decode("latin-1")
