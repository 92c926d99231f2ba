"""TOML as it is read from files that others wrote: whatever stands in them, the answer is a table or one fault."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from fusion.errors import FusionError

#: More than any campaign or recipe that a person writes, with thousands of file names listed one by one, bytes.
_MOST_BYTES = 1_000_000


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
        If it is not TOML, has numbers of thousands of digits or brackets without end, or is longer than 1 MB.
    UnicodeDecodeError
        If it is not UTF-8.
    OSError
        If it cannot be read.

    Notes
    -----
    TOML 1.0, https://toml.io/en/v1.0.0.
    """
    with path.open("rb") as file:
        content = file.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise TomlError(f"it is longer than {_MOST_BYTES // 1_000_000} MB; name many files by a pattern")
    # Line ends become one character, as of any text file.
    text = content.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    try:
        return tomllib.loads(text), text
    except RecursionError:
        raise TomlError("brackets stand in brackets too many times") from None
    # Also whole numbers of thousands of digits, which the parser hands to Python.
    except ValueError as error:
        raise TomlError(str(error)) from None
