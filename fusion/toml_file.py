"""TOML as it is read from files that others wrote: whatever stands in them, the answer is a table or one fault."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path
from typing import Any

from fusion.errors import FusionError

#: More than any campaign or recipe that a person writes, with thousands of file names listed one by one, bytes.
_MOST_BYTES = 1_000_000
#: Files that Linux makes when they are read, some of which wait or never end.
OF_THE_SYSTEM = ("/proc/", "/sys/")
#: More levels than any key of a campaign or recipe has: ``table.key`` with lists of lists is four.
_MOST_LEVELS = 32
_STRING = r"""(?:"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
#: A key of more levels, wherever it stands; the parser's time grows with the square of their number. What stands in comments and strings is
#: no key; a string without its end takes what it could, because the parser comes no further.
_DEEP_KEY = re.compile(
    r"""#[^\n]*+|"{3}(?:[^"\\]|\\[\s\S]|"(?!""))*+"{0,5}+|'{3}(?:[^']|'(?!''))*+'{0,5}+"""
    rf"""|(?P<key>(?<![\w-])(?:(?:[\w-]++|{_STRING})[ \t]*+\.[ \t]*+){{{_MOST_LEVELS}}})"""
    r"""|"(?:[^"\\\n]|\\.)*+"?+|'[^'\n]*+'?+"""
)
#: Whole numbers of TOML have 64 bits.
_INTEGERS = range(-(2**63), 2**63)
_TOO_DEEP = (
    f"brackets stand in brackets too many times, more than {_MOST_LEVELS} levels; no key here needs more than four"
)


class TomlError(FusionError):
    """Text that is no TOML, or not of a size that is read; the message says where, without the name of the file."""


def read_toml(path: Path) -> tuple[dict[str, Any], str]:
    """Read a file of TOML.

    Parameters
    ----------
    path : Path
        Campaign file, or recipe of a simulation.

    Returns
    -------
    dict
        Its tables.
    str
        Its text.

    Raises
    ------
    TomlError
        If it is not TOML or no file, has whole numbers of more than 64 bits or more than 32 levels, or is longer than 1 MB.
    UnicodeDecodeError
        If it is not UTF-8.
    OSError
        If it cannot be read.

    Notes
    -----
    TOML 1.0, https://toml.io/en/v1.0.0.
    """
    if os.path.realpath(path).startswith(OF_THE_SYSTEM):
        raise TomlError("it is a part of the system and no file that was written; name a campaign file or a recipe")
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise TomlError("it is a pipe, a socket or a device; name a file")
    with path.open("rb") as file:
        content = file.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise TomlError(f"it is longer than {_MOST_BYTES // 1_000_000} MB; name many files by a pattern")
    # Line ends become one character, as of any text file; a byte order mark, with which editors of Windows begin UTF-8, is no text.
    text = content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    deep = next((found for found in _DEEP_KEY.finditer(text) if found["key"]), None)
    if deep is not None:
        line = text.count("\n", 0, deep.start()) + 1
        raise TomlError(f"line {line} has a key of more than {_MOST_LEVELS} levels; no key here needs more than four")
    try:
        tables = tomllib.loads(text)
    except RecursionError:
        raise TomlError(_TOO_DEEP) from None
    # Also whole numbers of thousands of digits, which the parser hands to Python.
    except ValueError as error:
        raise TomlError(str(error)) from None
    _require_bounds(tables)
    return tables, text


def _require_bounds(tables: dict[str, Any]) -> None:
    """Refuse what the format allows and no reader of the values expects: levels without end, whole numbers beyond 64 bits."""
    level: list[tuple[str, Any]] = list(tables.items())
    for _ in range(_MOST_LEVELS):
        for key, value in level:
            if isinstance(value, int) and value not in _INTEGERS:
                raise TomlError(f"{key} is a whole number beyond 64 bits; write a smaller one")
        level = [
            (f"{key}.{name}" if isinstance(value, dict) else key, item)
            for key, value in level
            if isinstance(value, dict | list)
            for name, item in (value.items() if isinstance(value, dict) else enumerate(value))
        ]
    if level:
        raise TomlError(_TOO_DEEP)
