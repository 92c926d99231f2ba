"""Where `data/` lies, what the program knows and no one computes: in the installed package, or at the top of a clone."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

#: Name of a variable -> (dims, units, kind), kind being a NumPy dtype kind (``f``, ``i``, ``u``, ``M``).
Contract = dict[str, tuple[tuple[str, ...], str, str]]


def resource(name: str) -> Path:
    """Return the path of a file or folder of `data/`."""
    package = Path(__file__).parent
    installed = package / "data"
    return (installed if installed.is_dir() else package.with_name("data")) / name


@cache
def vocabulary(name: str) -> dict[str, Any]:
    """Return the words of a file in `data/vocabulary/`."""
    return tomllib.loads(resource(f"vocabulary/{name}.toml").read_text(encoding="utf-8"))


def sentence(words: str, table: str, code: str, **facts: object) -> str:
    """Return a sentence of a file in `data/vocabulary/` with the numbers and names behind it."""
    return str(vocabulary(words)[table][code].format(**facts))


def variables(product: str) -> tuple[Contract, dict[str, dict[str, str]]]:
    """Return the contract of a product, of the variables that others rely on, and the attributes of all of them."""
    described = vocabulary("variables")[product]
    contract = {
        name: (tuple(one["dims"]), one.get("units", ""), one["kind"])
        for name, one in described.items()
        if "kind" in one
    }
    attributes = {
        name: {key: text for key, text in one.items() if key not in ("dims", "kind")} for name, one in described.items()
    }
    return contract, attributes


#: Signs that are typed or decoded for the degree sign: ordinals and rings above, UTF-8 read in a code page, a character that was lost.
_DEGREE = re.compile(r"Â?[°º˚∘]\s*|\ufffd(?=[CF]$)")


def with_degree_sign(unit: str) -> str:
    """Return a unit with the degree sign in place of what looks like it.

    >>> [with_degree_sign(unit) for unit in ("ºC", "˚ C", "Â°C", "℃", "1/min")]
    ['°C', '°C', '°C', '°C', '1/min']
    """
    return _DEGREE.sub("°", unit.strip().replace("℃", "°C").replace("℉", "°F"))


def by_word(meanings: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return what each word stands for, of the words for each meaning."""
    return {word: meaning for meaning, words in meanings.items() for word in words}
