"""Faults of a campaign file as sentences: file, line, key, value, remedy.

Where a key stands in a TOML file, so that an error can name the line.
"""

from __future__ import annotations

import difflib
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from fusion.errors import FusionError
from interferometry.errors import InterferometryError
from thermography.errors import ThermographyError

#: From the path of a key to ``"FILE, line N"``.
Place = Callable[[tuple[str, ...]], str]

#: What to write instead, where pydantic's own words only name a Python type.
_REMEDIES = {
    "tuple_type": 'this is a list; write for example ["a", "b"]',
    "string_type": "this is text; write it in quotes",
    "float_type": "this is a number without quotes",
    "float_parsing": "this is a number without quotes",
    "string_too_short": "this text is empty; fill it in",
    "too_short": "this list is empty; fill it in",
    "model_type": "this is a table; write it as [name] with its keys below",
}
#: Characters of a name that a file may have.
_LONGEST_NAME = 255
#: Faults of one file that are told one by one.
_MOST_FAULTS = 30


@contextmanager
def naming(file: Path, *, readings: Path | None = None) -> Iterator[None]:
    """Put the file in front of the message of an error that is raised within by what does not know the file.

    Parameters
    ----------
    file : Path
        The campaign file, or what else was asked for.
    readings : Path or None
        File of the readings, which errors of the package `interferometry` are about; None where they are about `file` too.

    Raises
    ------
    FusionError, InterferometryError, ThermographyError
        The same error; a message that begins with a path is left as it is.

    Examples
    --------
    >>> with naming(Path("x/campaign.toml")):
    ...     raise FusionError("the plan grids differ")
    Traceback (most recent call last):
    fusion.errors.FusionError: x/campaign.toml: the plan grids differ
    """
    try:
        yield
    except (FusionError, InterferometryError, ThermographyError) as error:
        about = readings if readings is not None and isinstance(error, InterferometryError) else file
        text = str(error)
        if not text.startswith(str(file)) and not re.match(r"\s*\S*[/\\]", text):
            error.args = (f"{about}: {text}",)
        raise


def suggest(name: str, known: Iterable[str]) -> str:
    """Return ``"did you mean X? "`` for the nearest known name, or nothing where none is near.

    Parameters
    ----------
    name : str
        What was written.
    known : iterable of str
        What could have been meant.
    """
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f"did you mean {near[0]}? " if near else ""


def near_file(path: Path) -> str:
    """Return the hint that names the nearest file of the same folder.

    Parameters
    ----------
    path : Path
        What was named, and is not there.
    """
    if len(path.name) > _LONGEST_NAME or not os.path.isdir(path.parent):  # noqa: PTH112 - as for the file, a name that is too long
        return ""
    names = [item.name for item in path.parent.iterdir() if item.is_file()]
    return suggest(path.name, names)


def first_faults(faults: Iterable[str], path: Path) -> list[str]:
    """Return the faults of a campaign file that are told, each once; of very many the first, and how many more there are.

    Parameters
    ----------
    faults : iterable of str
        One sentence each.
    path : Path
        The campaign file.
    """
    told = list(dict.fromkeys(faults))
    more = len(told) - _MOST_FAULTS
    return told if more <= 0 else [*told[:_MOST_FAULTS], f"{path}: and {more} more faults"]


def describe(item: ErrorDetails, model: type[BaseModel], place: Place) -> str:
    """Turn one pydantic error of a `model` into a sentence with place, key, value and remedy.

    Parameters
    ----------
    item : dict
        Error of pydantic.
    model : type of BaseModel
        Model that was validated; its aliases are the keys of the file.
    place : callable
        From the path of a key to file and line.
    """
    names = tuple(
        part for part in item["loc"] if isinstance(part, str) and not part.startswith(("function-", "tuple["))
    )
    dotted = ".".join(names)
    where = place(tuple(str(part) for part in item["loc"] if isinstance(part, int) or part in names))
    if item["type"] == "extra_forbidden":
        return f"{where}: unknown key {dotted}; {_nearest(names, model)}"
    if item["type"] == "missing":
        table = ".".join(names[:-1])
        if item["loc"] and isinstance(item["loc"][-1], int):
            return f"{where}: {dotted} needs {int(item['loc'][-1]) + 1} values"
        if not table:
            return f"{where}: the table [{dotted}] is missing; add it, see the campaign file in the README"
        return f"{where}: [{table}] lacks {names[-1]}; add it, see the campaign file in the README"
    remedy = _REMEDIES.get(item["type"], item["msg"][0].lower() + item["msg"][1:])
    if isinstance(item["input"], dict):
        return f"{where}: [{dotted}]: {remedy}"
    return f"{where}: {dotted} = {_shown(item['input'])}: {remedy}"


def as_written(item: ErrorDetails, content: Mapping[str, Any]) -> ErrorDetails:
    """Return the fault of an uncertainty under the key that states it: ``emissivity = "0.97 +- 2"`` has no line ``emissivity_u``.

    Parameters
    ----------
    item : dict
        Error of pydantic.
    content : mapping
        What was validated.
    """
    *outer, name = item["loc"] or ("",)
    if not isinstance(name, str) or not name.endswith("_u"):
        return item
    table: Any = content
    try:
        for part in outer:
            table = table[part]
        written = table if name in table else table[name.removesuffix("_u")]
    except (KeyError, IndexError, TypeError):
        return item
    if written is table:
        return item
    return {**item, "loc": (*outer, name.removesuffix("_u")), "input": written}


def _shown(value: object) -> str:
    """Return a value as it is written in TOML, cut where it is long."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _nearest(names: tuple[str, ...], model: type[BaseModel]) -> str:
    """Return the hint that follows an unknown key: the nearest known one, and all that its table knows."""
    for name in names[:-1]:
        model = next(
            _table_in(field.annotation) for key, field in model.model_fields.items() if (field.alias or key) == name
        )
    known = sorted(field.alias or key for key, field in model.model_fields.items() if not field.exclude)
    return f"{suggest(names[-1], known)}known here: {', '.join(known)}"


def _table_in(annotation: Any) -> type[BaseModel]:
    """Return the table class inside an annotation such as ``PlanTable | None``."""
    candidates = getattr(annotation, "__args__", (annotation,))
    return next(item for item in candidates if isinstance(item, type) and issubclass(item, BaseModel))


_HEADER = re.compile(r"\s*(\[+)\s*([^\[\]]+?)\s*\]+\s*(?:#.*)?")
_KEY = re.compile(r"""\s*((?:[\w-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[\w-]+|"[^"]*"|'[^']*'))*)\s*=""")
_PART = re.compile(r"""[\w-]+|"[^"]*"|'[^']*'""")


def key_lines(text: str) -> dict[tuple[str, ...], int]:
    """Return the line number (from 1) of every key and table header of a TOML text.

    Keys inside inline tables have no line of their own; `find_line` answers with that of the key that holds them. In the path of a table
    of an array, ``[[region]]``, its number from 0 follows the name.

    Parameters
    ----------
    text : str
        Content of a TOML file.

    Returns
    -------
    dict
        Line by path of the key.
    """
    lines: dict[tuple[str, ...], int] = {}
    table: tuple[str, ...] = ()
    last: dict[tuple[str, ...], int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.fullmatch(line):
            table = ()
            for part in _parts(header.group(2)):
                table += (str(last[table]), part) if table in last else (part,)
            lines.setdefault(table, number)
            if len(header.group(1)) == 2:
                last[table] = last.get(table, -1) + 1
                table += (str(last[table]),)
                lines[table] = number
        elif key := _KEY.match(line):
            path = table + _parts(key.group(1))
            for depth in range(len(table) + 1, len(path) + 1):
                lines.setdefault(path[:depth], number)
    return lines


def find_line(lines: dict[tuple[str, ...], int], path: tuple[str, ...]) -> int:
    """Return the line of a key, else that of the nearest table or key that would hold it, else 1.

    Parameters
    ----------
    lines : dict
        Result of `key_lines`.
    path : tuple of str
        Path of a key.
    """
    for depth in range(len(path), 0, -1):
        if path[:depth] in lines:
            return lines[path[:depth]]
    return 1


def _parts(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip("\"'") for part in _PART.findall(dotted))
