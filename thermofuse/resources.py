"""Where `data/` lies, what the program knows and no one computes: in the installed package, or at the top of a clone."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any


def resource(name: str) -> Path:
    """Return the path of a file or folder of `data/`."""
    package = Path(__file__).parent
    installed = package / "data"
    return (installed if installed.is_dir() else package.with_name("data")) / name


@cache
def vocabulary(name: str) -> dict[str, Any]:
    """Return the words of a file in `data/vocabulary/`."""
    return tomllib.loads(resource(f"vocabulary/{name}.toml").read_text(encoding="utf-8"))


def variables(product: str) -> tuple[dict[str, tuple[tuple[str, ...], str, str]], dict[str, dict[str, str]]]:
    """Return the contract of a product, (dims, units, kind) of the variables that others rely on, and the attributes of all of them."""
    described = deepcopy(vocabulary("variables")[product])
    contract = {
        name: (tuple(one.pop("dims")), one.get("units", ""), one.pop("kind"))
        for name, one in described.items()
        if "kind" in one
    }
    return contract, described


def by_word(meanings: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return what each word stands for, of the words for each meaning."""
    return {word: meaning for meaning, words in meanings.items() for word in words}
