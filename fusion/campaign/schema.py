"""The keys of the campaign file as `config.py` declares them: what form, draft, sheet and reference are made from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import date
from functools import cache
from typing import Any, NamedTuple

from fusion.campaign.config import campaign_schema
from fusion.campaign.values import QuantityError, canonical_unit, read_cycles, read_quantity
from fusion.results.numbers import print_unit


class Key(NamedTuple):
    """One value that somebody states: a key of a table, an item of a list of fixed length, or a key of a line of a list of tables.

    `kind` is "text", "number", "quantity" with a `unit`, "cycles", "date" or "list" of texts; `title` is that of the table. `about` says
    more than the label, `absent` what holds where it is left out, `choices` what its values mean. `thermofuse init` asks for it (`ask`)
    or shows it in a comment (`show`). It says something only with one of the tables `of`, and where those of `within` are there; a
    campaign cannot run without a `needed` one. A table with lines calls one of them `row`, and shows `rows` of them where none is stated.
    """

    table: tuple[str, ...]
    key: str
    label: str
    title: str = ""
    kind: str = "text"
    unit: str = ""
    example: str = ""
    default: str = ""
    about: str = ""
    absent: str = ""
    ask: bool = False
    show: bool = False
    of: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    choices: Mapping[str, str] = {}
    item: int | None = None
    items: int = 0
    line: int | None = None
    needed: bool = False
    within: tuple[tuple[str, ...], ...] = ()
    row: str = ""
    rows: int = 0

    @property
    def name(self) -> str:
        """Its dotted name."""
        parts = [*self.table, self.line, self.key, self.item]
        return ".".join(str(part) for part in parts if part is not None)

    @property
    def shown(self) -> str:
        """Its label with the unit of a quantity."""
        return f"{self.label} ({print_unit(self.unit)})" if self.unit else self.label

    def check(self, text: str) -> str:
        """Return a text that is a quantity of its unit, a range of cycles, a day or one of several words, where it has to be."""
        if self.kind == "quantity":
            read_quantity(text, canonical_unit(self.unit))
        elif self.kind == "cycles":
            read_cycles(text)
        elif self.options and text not in self.options:
            raise QuantityError(f'"{text}" is none of {", ".join(filter(None, self.options))}')
        elif self.kind == "date":
            try:
                return date.fromisoformat(text).isoformat()
            except ValueError:
                raise QuantityError(f'"{text}" is no day; write year-month-day, for example {self.example}') from None
        return text

    @property
    def first(self) -> bool:
        """Whether `thermofuse init` writes it and the form shows it unfolded."""
        return self.ask or self.show or self.needed

    @property
    def told(self) -> str:
        """What it is, as far as its name does not say it."""
        label = "" if self.label.lower().replace("-", "_").replace(" ", "_") == self.key else self.label
        return "; ".join(filter(None, (label, self.about)))

    @property
    def remark(self) -> str:
        """What it is, what its values mean, and what holds where it is left out."""
        meanings = [f'"{value}": {self.choices[value]}' for value in self.options if value in self.choices]
        return "; ".join(filter(None, (self.told, *meanings, self.absent and f"left out: {self.absent}")))


@cache
def known_keys() -> dict[str, Key]:
    """Return every key of a campaign file that holds text, a number or a list of texts, by its dotted name."""
    schema = campaign_schema()
    return {one.name: one for one in _keys_of(Key((), "", ""), schema, schema["$defs"])}


def keys_of(*table: str, of: str = "") -> list[Key]:
    """Return the keys of a table, those that say something with another table if one is named."""
    listed = [one for one in known_keys().values() if one.table == table]
    return [one for one in listed if not of or not one.of or of in one.of]


def _keys_of(outer: Key, model: Mapping[str, Any], models: Mapping[str, Any]) -> Iterator[Key]:
    """Yield the keys of a table and of the tables in it, with what holds for all of them from `outer`."""
    for key, given in model["properties"].items():
        spec, optional = _resolved(given, models)
        inner, _ = _resolved(spec.get("items") or spec.get("additionalProperties") or {}, models)
        table = (*outer.table, key)
        within = outer._replace(table=table, of=tuple(given.get("of", outer.of)))
        if "properties" in spec:
            yield from _keys_of(
                within._replace(title=spec["title"], within=(*outer.within, *([table] if optional else []))),
                spec,
                models,
            )
        elif "properties" in inner:
            # Corners of a region are drawn, roles of columns are chosen beside their values.
            if "rows" in given:
                lines = within._replace(title=inner["title"], row=given["title"], rows=given["rows"])
                named = lines._replace(key="name", label=f"Name of the {given['title'].lower()}")
                yield from [] if "name" in inner["properties"] else [named]
                yield from _keys_of(lines, inner, models)
        elif spec.get("type") != "object":
            yield from _values_of(outer._replace(key=key), given, spec, optional, models)


def _values_of(
    outer: Key, given: Mapping[str, Any], spec: Mapping[str, Any], optional: bool, models: Mapping[str, Any]
) -> Iterator[Key]:
    """Yield a key, or each item of a list of fixed length."""
    parts = {name: given[name] for name in ("absent", "ask", "show", "choices", "needed") if name in given}
    common = outer._replace(about=given.get("description", ""), of=tuple(given.get("of", outer.of)), **parts)
    example = given.get("examples", [""])[0]
    labels = given.get("labels", [given["title"]])
    for item, label in enumerate(labels):
        one = _resolved(spec["prefixItems"][item], models)[0] if len(labels) > 1 else spec
        written = str(example[item] if isinstance(example, list) else example or one.get("examples", [""])[0])
        kinds = {"array": "list", "number": "number", "integer": "number"}
        kind = "text" if "prefixItems" in one else one.get("format") or kinds.get(one.get("type", ""), "text")
        options = tuple(map(str, one.get("enum", ())))
        absent = "" if optional else str(given.get("default", options[:1] and options[0]) or "")
        unit, number = written.rpartition(" ")[2] if kind == "quantity" else "", given.get("default")
        value = common._replace(
            label=label,
            kind=kind,
            unit=unit,
            default=f"{number:g} {unit}" if unit and number is not None else "",
            example=written or next(filter(None, options), ""),
            options=tuple(dict.fromkeys((absent, *options))) if options else (),
        )
        yield value._replace(item=item, items=len(labels)) if len(labels) > 1 else value


def _resolved(spec: Mapping[str, Any], models: Mapping[str, Any]) -> tuple[Mapping[str, Any], bool]:
    """Return what a value may be beside nothing, and whether it may be nothing."""
    choices = [one for one in spec.get("anyOf", [spec]) if one.get("type") != "null"]
    chosen = choices[0] if choices else spec
    if "$ref" in chosen:
        chosen = models[chosen["$ref"].rpartition("/")[2]]
    return chosen, len(choices) < len(spec.get("anyOf", [spec]))
