"""TOML files that a user writes: read into tables, and their faults as sentences with line, key, value and remedy (pydantic finds them)."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from fusion.common import FusionError, suggest

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

#: From the path of a key to ``"FILE, line N"``.
Place = Callable[[tuple[str, ...]], str]

#: More than any campaign or recipe that a person writes, with thousands of file names listed one by one, bytes.
_MAX_BYTES = 1_000_000
#: A key of more parts than any has, whose parts the parser copies once for each of them.
_TOO_DEEP = re.compile(r"""(?<![\w.-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){64}""")
#: Whole numbers of TOML have 64 bits.
_INTEGERS = range(-(2**63), 2**63)
#: Faults of one file that are listed one by one.
_MAX_FAULTS = 30
#: What to write instead, where pydantic's own words only name a Python type.
_REMEDIES = {
    "dataclass_type": "this is a table; write it as [name] with its keys below",
    "model_type": "this is a table; write it as [name] with its keys below",
    "tuple_type": 'this is a list; write for example ["a", "b"]',
    "string_type": "this is text; write it in quotes",
    "int_type": "this is a whole number without quotes",
    "float_type": "this is a number without quotes",
    "float_parsing": "this is a number without quotes",
    "string_too_short": "this text is empty; fill it in",
    "too_short": "this list is empty; fill it in",
}


class TomlError(FusionError):
    """Text that is no TOML, or not of a size that is read; the message says where, without the name of the file."""


def read_toml(path: Path) -> tuple[dict[str, Any], str]:
    """Return the tables and the text of a TOML file."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise TomlError("it is a pipe, a socket or a device; name a file")
    with path.open("rb") as file:
        content = file.read(_MAX_BYTES + 1)
    if len(content) > _MAX_BYTES:
        raise TomlError(f"it is longer than {_MAX_BYTES // 1_000_000} MB; name many files by a pattern")
    # Line ends become one character, as of any text file; a byte order mark, with which editors of Windows begin UTF-8, is no text.
    text = content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    try:
        if _TOO_DEEP.search(text):
            raise RecursionError
        tables = tomllib.loads(text)
        beyond = any(number not in _INTEGERS for number in _whole_numbers(tables))
    except RecursionError:
        raise TomlError("tables or brackets are nested too deep; no key here needs more than four levels") from None
    except ValueError as error:  # Also whole numbers of thousands of digits, which the parser hands to Python.
        raise TomlError(str(error)) from None
    if beyond:
        raise TomlError("it holds a whole number beyond 64 bits; write a smaller one")
    return tables, text


def _whole_numbers(value: Any) -> Iterator[int]:
    """Yield every whole number in a value of TOML."""
    if isinstance(value, int):
        yield value
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _whole_numbers(item)


def first_faults(faults: Iterable[str], path: Path | str) -> str:
    """Return the faults of a file, each once and one per line; of very many the first, and how many more there are."""
    listed = list(dict.fromkeys(faults))
    more = len(listed) - _MAX_FAULTS
    return "\n".join(listed if more <= 0 else [*listed[:_MAX_FAULTS], f"{path}: and {more} more faults"])


def describe(item: ErrorDetails, model: type, place: Place) -> str:
    """Turn one pydantic error of a model or dataclass into a sentence with place, key, value and remedy."""
    names = tuple(
        part for part in item["loc"] if isinstance(part, str) and not part.startswith(("function-", "tuple["))
    )
    dotted = ".".join(names)
    where = place(tuple(str(part) for part in item["loc"] if isinstance(part, int) or part in names))
    if item["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{where}: unknown key {dotted}; {_nearest(names, model)}"
    if item["type"] == "missing":
        table = ".".join(names[:-1])
        if item["loc"] and isinstance(item["loc"][-1], int):
            return f"{where}: {dotted} needs {int(item['loc'][-1]) + 1} values"
        if not table:
            return f"{where}: the table [{dotted}] is missing; add it"
        return f"{where}: [{table}] lacks {names[-1]}; add it"
    if item["type"] == "value_error":
        remedy = str(item["ctx"]["error"])
    elif item["type"] == "too_long":
        remedy = f"it takes {item['ctx']['max_length']} values, not {item['ctx']['actual_length']}"
    else:
        remedy = _REMEDIES.get(item["type"], item["msg"][0].lower() + item["msg"][1:])
    if isinstance(item["input"], dict):
        return f"{where}: [{dotted}]: {remedy}"
    shown = json.dumps(item["input"], ensure_ascii=False, default=str)
    return f"{where}: {dotted} = {shown if len(shown) <= 80 else f'{shown[:77]}...'}: {remedy}"


def _nearest(names: tuple[str, ...], model: type) -> str:
    """Return the hint that follows an unknown key: the nearest known one, and all that its table knows."""
    for name in names[:-1]:
        # A table that the user names, a column of a record, is no key that is known beforehand.
        model = _table_in(_keys(model)[name]) if name in _keys(model) else model
    known = sorted(_keys(model))
    return f"{suggest(names[-1], known)}known here: {', '.join(known)}"


def _keys(model: type) -> dict[str, Any]:
    """Return the annotation of every key that a table knows."""
    if hasattr(model, "model_fields"):
        return {
            field.alias or name: field.annotation for name, field in model.model_fields.items() if not field.exclude
        }
    hints = get_type_hints(model)
    return {field.name: hints[field.name] for field in fields(model)}


def _table_in(annotation: Any) -> type:
    """Return the table class inside an annotation such as ``PlanTable | None``."""
    candidates = get_args(annotation) or (annotation,)
    return next(item for item in candidates if is_dataclass(item) or hasattr(item, "model_fields"))


_HEADER = re.compile(r"\s*(\[+)\s*([^\[\]]+?)\s*\]+\s*(?:#.*)?")
_KEY = re.compile(r"""\s*((?:[\w-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[\w-]+|"[^"]*"|'[^']*'))*)\s*=""")
_PART = re.compile(r"""[\w-]+|"[^"]*"|'[^']*'""")


def place_in(path: Path, text: str) -> Place:
    """Return what says in which line of a TOML text a key stands."""
    lines = key_lines(text)
    return lambda key: f"{path}, line {find_line(lines, key)}"


def key_lines(text: str) -> dict[tuple[str, ...], int]:
    """Return the line number (from 1) of every key and table header of a TOML text."""
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
    """Return the line of a key, else that of the nearest table or key that would hold it, else 1."""
    return next((lines[path[:depth]] for depth in range(len(path), 0, -1) if path[:depth] in lines), 1)


def _parts(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip("\"'") for part in _PART.findall(dotted))
