"""Pages that are written from the code (modules, checks, command, campaign file, recipe, results), and tables of measured figures."""

from __future__ import annotations

import csv
import importlib
import inspect
import pkgutil
import re
import typing
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import typer.cli
import typer.main
from sphinx.application import Sphinx

import thermofuse
from fusion import cli
from fusion.analysis.consistency import RULES
from fusion.campaign.config import campaign_schema
from fusion.campaign.inspect import Kind
from fusion.report.wording import environment
from fusion.results.results import results_schema
from fusion.twin.recipe_file import recipe_schema
from interferometry.io.readings import FILES, TABLES
from thermofuse.resources import vocabulary
from thermography.io.other_cameras import plug_ins, readers

PACKAGES = ("thermography", "interferometry", "fusion")


def first_sentence(text: str | None) -> str:
    """Return the first paragraph of a docstring in one line."""
    return " ".join((text or "").strip().partition("\n\n")[0].split())


def folders() -> dict[str, list[str]]:
    """Return every folder of the packages by dotted name, with its modules in alphabetical order."""
    found: dict[str, list[str]] = {}
    for package in PACKAGES:
        found[package] = [package]
        root = importlib.import_module(package)
        for module in pkgutil.walk_packages(root.__path__, f"{package}."):
            if module.name.rpartition(".")[2].startswith("__"):
                continue
            home = module.name if module.ispkg else module.name.rpartition(".")[0]
            found.setdefault(home, [home])
            if not module.ispkg:
                found[home].append(module.name)
    return found


def api_page(folder: str, modules: list[str]) -> str:
    """Return the page of a folder: its modules with every public class and function."""
    title = f"{folder}"
    lines = [title, "=" * len(title), ""]
    for module in modules:
        name = module.removeprefix(f"{folder}.")
        lines += [] if module == folder else [name, "-" * len(name), ""]
        lines += [
            f".. automodule:: {module}",
            "   :members:",
            "   :ignore-module-all:",
            "   :show-inheritance:",
            "",
        ]
    return "\n".join(lines)


def home_of(thing: Any, name: str) -> str:
    """Return the dotted name under which a public object is defined."""
    module = getattr(thing, "__module__", "")
    return f"{module}.{getattr(thing, '__qualname__', name)}"


def names_table(names: Mapping[str, Any]) -> str:
    """Return a table of public names, each with a link to its description and the first sentence of it."""
    rows = ["| name | what it does |", "|---|---|"]
    for name, thing in names.items():
        role = "class" if inspect.isclass(thing) else "func"
        rows.append(f"| {{py:{role}}}`{name} <{home_of(thing, name)}>` | {first_sentence(thing.__doc__)} |")
    return "\n".join(rows) + "\n"


def public_names() -> Iterator[tuple[str, str]]:
    """Yield a table of names for thermofuse and for each package."""
    yield "thermofuse", names_table({name: getattr(thermofuse, name) for name in thermofuse.__all__})
    for package in PACKAGES:
        module = importlib.import_module(package)
        names = {name: getattr(module, name) for name in module.__all__}
        yield package, names_table(names)


def type_of(schema: Mapping[str, Any]) -> str:
    """Say in a few words what a value of a JSON Schema may be."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{anchor(name)})"
    if "anyOf" in schema or "oneOf" in schema:
        choices = [type_of(choice) for choice in schema.get("anyOf", schema.get("oneOf", []))]
        return " or ".join(dict.fromkeys(choices))
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    if "const" in schema:
        return f"`{schema['const']}`"
    kind = schema.get("type", "any value")
    if schema.get("format") == "quantity":
        return f"number with unit, as `{schema['examples'][0]}`"
    if kind == "array" and "prefixItems" in schema:
        return f"list of {len(schema['prefixItems'])}: {type_of(schema['prefixItems'][0])}"
    if kind == "array":
        return f"list of {type_of(schema.get('items', {}))}"
    if kind == "object" and isinstance(schema.get("additionalProperties"), Mapping):
        return f"object of {type_of(schema['additionalProperties'])}"
    return str(kind)


def anchor(name: str) -> str:
    """Return the target of a model's section."""
    return f"model-{name.lower().replace(' ', '-')}"


def cell(text: str) -> str:
    """Return a text as one cell of a Markdown table."""
    return " ".join(text.split()).replace("|", "\\|").replace("*", "\\*").replace("[[", "&#91;[").replace("<", "&lt;")


def model_section(name: str, schema: Mapping[str, Any], models: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the section of one model: its description and a row for each key."""
    rows = kinds_table(schema["oneOf"]) if "oneOf" in schema else keys_table(schema, models)
    about = first_sentence(schema.get("description")).replace("``", "`")
    return f"({anchor(name)})=\n## {schema.get('heading', name)}\n\n{about}\n\n" + "\n".join(rows) + "\n\n"


def keys_table(schema: Mapping[str, Any], models: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a row for each key of a model; a table within it means what its own model says."""
    rows = ["| key | value | left out | meaning |", "|---|---|---|---|"]
    for key, value in schema.get("properties", {}).items():
        named = re.search(r"#/\$defs/(\w+)", str(value))
        model = models.get(named[1], {}) if named else {}
        means = cell(value.get("description") or first_sentence(model.get("description")).replace("``", "`"))
        rows.append(f"| `{key}` | {type_of(value)} | {left_out(key, schema)} | {means} |")
    return rows


def left_out(key: str, schema: Mapping[str, Any]) -> str:
    """Say what holds where a key is left out."""
    if key in schema.get("required", []):
        return "must be given"
    value = schema["properties"][key]
    default, written = value.get("default"), value.get("examples", [""])[0]
    unit = f" {written.rpartition(' ')[2]}" if value.get("format") == "quantity" else ""
    none = default in (None, "", []) or isinstance(default, dict)
    return value.get("absent") or ("" if none else f"`{default}{unit}`")


def kinds_table(kinds: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a row for each kind of a model whose keys hang on its name, and a row for each of these keys."""
    rows = ["| name | further keys, with the values that hold where they are left out |", "|---|---|"]
    known: dict[str, Mapping[str, Any]] = {}
    for kind in kinds:
        keys = {key: value for key, value in kind["properties"].items() if key != "name"}
        said = [f"`{key} = {value['default']}`" for key, value in keys.items() if value.get("default") is not None]
        rows.append(f"| `{kind['title']}` | {', '.join(said)} |")
        known |= keys
    meanings = [f"| `{key}` | {cell(value['description'])} |" for key, value in known.items()]
    return [*rows, "", "| key | meaning |", "|---|---|", *meanings]


def schema_page(schema: Mapping[str, Any]) -> str:
    """Return the models of a JSON Schema, the outermost first."""
    models = {schema.get("title", "file"): schema, **schema.get("$defs", {})}
    return "".join(model_section(name, model, models) for name, model in models.items())


def campaign_page(schema: Mapping[str, Any]) -> str:
    """Return the tables of the campaign file as a user writes them: their names in brackets, meanings as the keys are declared."""
    models = {}
    for name, model in schema["$defs"].items():
        heading, _, about = first_sentence(model.get("description")).replace("`", "").partition(": ")
        table = re.fullmatch(r"\[+([\w.]+)\]+", heading)
        properties = {key: written(value) for key, value in model.get("properties", {}).items()}
        described = {"heading": heading, "description": f"{about[:1].upper()}{about[1:]}"} if table else {}
        models[name] = model | {"properties": properties} | described
    tables = {key: written(value) for key, value in schema["properties"].items()}
    return schema_page(
        schema | {"properties": tables, "$defs": models, "title": "Tables of the file", "description": ""}
    )


def meaning(value: Mapping[str, Any]) -> str:
    """Return what a key is called, what else is said of it, and what its values mean; nothing of a table, which says it itself."""
    if "/$defs/" in str(value) and not value.get("description"):
        return ""
    told = [*value.get("labels", [value["title"]]), value.get("description", "")]
    return "; ".join(filter(None, [*told, *(f"`{one}`: {text}" for one, text in (value.get("choices") or {}).items())]))


def written(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return a property with its meaning, without what TOML has no word for: null, and tables as they are where they are left out."""
    kept = [choice for choice in value.get("anyOf", []) if choice.get("type") != "null"]
    rest = {key: part for key, part in value.items() if key != "anyOf"} | {"description": meaning(value)}
    return rest | ({"anyOf": kept} if kept else {})


def command_page() -> str:
    """Return what `thermofuse --help` and the help of every command say."""
    command = typer.main.get_command(cli.app)
    context = typer.Context(command, info_name="thermofuse")
    text = typer.cli.get_docs_for_click(obj=command, ctx=context, name="thermofuse")
    return text.partition("\n")[2]


def table_of(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [heads, ["---"] * len(heads), *([cell(text) for text in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def format_tables() -> dict[str, str]:
    """Return the tables of `formats.md` by name: kinds, readers and layouts as they are declared, with what the vocabulary says of each."""
    said = dict(vocabulary("formats"))
    kinds = [kind.value for kind in Kind if kind not in (Kind.UNKNOWN, Kind.UNREADABLE)]
    layouts = {
        "frames": {one.name: said["frames"][one.name] for one in readers()[len(plug_ins()) :]},
        "deviations": {one.name: said["deviations"][one.name] for one in (*FILES, *TABLES)},
        "logged": said["logged"],
    }
    tables = {
        name: table_of(
            ("kind", "what is read", "asked", "tried on"),
            [
                (
                    f"{kind} ({one['files']})" if "files" in one else kind,
                    one["read"],
                    one.get("asked", ""),
                    one["tried"],
                )
                for kind, one in of_name.items()
            ],
        )
        for name, of_name in layouts.items()
    }
    keys = [(one.words, f"`{one.key}`" if one.key else "", said["kinds"][one.words]) for one in kinds]
    unread = {one["words"]: ", ".join(one.get("endings", ())) for one in vocabulary("frames")["unread"]}
    pairs = {
        "limits": ("file", "at most"),
        "times": ("", "read"),
        "readings": ("", "accepted"),
        "not_read": ("file", "why, and what to do"),
    }
    said["not_read"] = said["not_read"] | {ends: words for words, ends in unread.items() if ends}
    return (
        tables
        | {"kinds": table_of(("kind", "key", "told by"), keys)}
        | {name: table_of(heads, [*said[name].items()]) for name, heads in pairs.items()}
    )


def checks_table() -> str:
    """Return a row for every consistency check: what its docstring compares, with the limits in the code, and what hangs on it."""
    conditions = environment(html=False).get_template("consistency.j2").module.conditions
    lines = ["| code | what is compared, and its limit | what has to be right | else endangered |", "|---|---|---|---|"]
    first: dict[str, str] = {}
    for code, rule in RULES.items():
        about = re.sub(r"`(_?[A-Z][A-Za-z_]+)`", partial(quoted, rule.find), rule.find.__doc__ or "")
        said = about if first.setdefault(about, code) == code else f"as `{first[about]}`"
        lines.append(f"| `{code}` | {' | '.join(cell(text) for text in (said, *conditions[code]))} |")
    return "\n".join(lines) + "\n"


def quoted(function: Any, name: re.Match[str]) -> str:
    """Return a constant of a function's module with its value."""
    return f"`{name[1].lstrip('_')} = {function.__globals__[name[1]]}`"


def measured_table(rows: Sequence[Mapping[str, str]]) -> str:
    """Return the figures of one section that are shown in `measured.md`; the last column is the aim where any row has one."""
    last = "aim" if any(row["aim"] for row in rows) else "n"
    lines = [f"| figure | measured | {last} |", "|---|---|---|"]
    for row in rows:
        value = row["value"] if row["unit"] in ("1", "share") else f"{row['value']} {row['unit']}"
        interval = f" ({row['interval']})" if row["interval"] else ""
        lines.append(f"| {row['figure']} | {value}{interval} | {row[last]} |")
    return "\n".join(lines) + "\n"


def measured_page(text: str, rows: Sequence[Mapping[str, str]]) -> str:
    """Return the text of `measured.md` with the table of each section made again from the rows of `measured.csv`."""
    parts = re.split(r"^(?=## )", text, flags=re.M)
    for number, part in enumerate(parts):
        title = part.partition("\n")[0].removeprefix("## ")
        shown = [row for row in rows if row["section"] == title and row["page"]]
        parts[number] = re.sub(r"^\|.*\n(?:\|.*\n)*", lambda _, shown=shown: measured_table(shown), part, flags=re.M)
    return "".join(parts)


def coverage_table(rows: Sequence[Mapping[str, str]]) -> str:
    """Return the measured figures of `measured.csv` on what intervals hold, each with its command."""
    lines = ["| figure | measured | n | command |", "|---|---|---|---|"]
    for row in rows:
        if row["section"] == "Coverage of intervals":
            interval = f" ({row['interval']})" if row["interval"] else ""
            lines.append(f"| {row['figure']} | {row['value']}{interval} | {row['n']} | `{row['command']}` |")
    return "\n".join(lines) + "\n"


def measured_rows(path: Path) -> list[dict[str, str]]:
    """Return the measured figures of `measured.csv`, one a row."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def write_if_new(path: Path, text: str) -> None:
    """Write a page unless it says so already, so that it is not read again for nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def write_pages(app: Sphinx) -> None:
    """Write all pages that come from the code, and remove those of folders that are gone."""
    reference = Path(app.srcdir) / "reference"
    generated = reference / "_generated"
    pages = {reference / "api" / f"{folder}.rst": api_page(folder, modules) for folder, modules in folders().items()}
    for stale in set((reference / "api").glob("*.rst")) - set(pages):
        stale.unlink()
    pages |= {generated / f"names_{package}.md": table for package, table in public_names()}
    measured = Path(app.srcdir) / "measured.md"
    rows = measured_rows(measured.with_suffix(".csv"))
    pages[measured] = measured_page(measured.read_text(encoding="utf-8"), rows)
    pages |= {
        generated / "checks.md": checks_table(),
        generated / "coverage.md": coverage_table(rows),
        generated / "command.md": command_page(),
        generated / "campaign.md": campaign_page(campaign_schema()),
        generated / "recipe.md": schema_page(recipe_schema()),
        **{generated / f"formats_{name}.md": table for name, table in format_tables().items()},
        generated / "results.md": schema_page(results_schema()),
    }
    for path, text in pages.items():
        write_if_new(path, text)


def is_foreign(app: Sphinx, what: str, name: str, thing: Any, skip: bool, options: Any) -> bool | None:
    """Leave out aliases of types, which have no docstring of their own, and functions of other libraries."""
    home = getattr(thing, "__module__", None)
    foreign = isinstance(home, str) and what == "module" and home.partition(".")[0] not in PACKAGES
    return True if foreign or typing.get_origin(thing) is not None or isinstance(thing, TypeVar) else None


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages before Sphinx looks for them."""
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-skip-member", is_foreign)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
