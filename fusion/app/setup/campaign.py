"""The campaign file as text with values: drafted as `thermofuse init` does, or read back; its comments stay where values change."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, MutableMapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Array

from fusion.app.parts import PathError
from fusion.campaign.draft import DRAFTED, TO_FILL, Asker, draft_lines
from fusion.campaign.inspect import leads_out, scan_folder
from fusion.common import CAMPAIGN_FILE, FusionError
from fusion.results.store import write_atomically

#: Where the version of a campaign file goes that is replaced.
_BEFORE = "campaign.toml.before"

#: Names of tables and of the key in them.
Key = tuple[str, ...]


class CampaignTextError(FusionError):
    """A campaign file that cannot be opened or saved; the message says why and what to do."""


@dataclass(frozen=True)
class CampaignText:
    """A campaign file that is being written; `saved` is its content when it was opened or saved, None where there is none yet."""

    path: Path
    text: str
    saved: str | None

    @cached_property
    def content(self) -> dict[str, Any]:
        """What the text says."""
        return tomllib.loads(self.text)

    def value(self, *key: str) -> Any:
        """Return a value."""
        found: Any = self.content
        for name in key:
            found = found.get(name) if isinstance(found, dict) else None
        return _without_marks(found)

    def with_values(self, values: Mapping[Key, object]) -> CampaignText:
        """Return it with other values; comments and everything else stay."""
        text = self.text
        for (*tables, name), value in values.items():
            if value is not None:
                text = _uncommented(text, tables, name)
        document = tomlkit.parse(text)
        for (*tables, name), value in values.items():
            if value is None and self.value(*tables, name) is None:
                continue
            table: Any = document
            for each in tables:
                table = table.setdefault(each, tomlkit.table())
                if not isinstance(table, MutableMapping):
                    raise CampaignTextError(
                        f"{self.path}: {each} is no table; write [{'.'.join(tables)}] above its keys in an editor"
                    )
            _set(table, name, value)
        return replace(self, text=tomlkit.dumps(document))

    def save(self) -> CampaignText:
        """Write it into its folder; the version before stays beside it."""
        present = _read(self.path) if self.path.exists() else None
        if present != self.saved:
            raise CampaignTextError(
                f"{self.path} was changed by another page or program since it was opened here; look into the folder again to see its values"
            )
        if present == self.text:
            return self
        if present is not None:
            _write(self.path.with_name(_BEFORE), present)
        # New lines end as those of the file do.
        text = self.text.replace("\r\n", "\n").replace("\n", "\r\n") if "\r\n" in (present or "") else self.text
        _write(self.path, text)
        return CampaignText(self.path, text, text)


def open_campaign(folder: Path, root: Path | None = None) -> CampaignText:
    """Open the campaign file of a folder, or draft one where there is none; links out of `root`, else of the folder, are not followed."""
    path, root = folder / CAMPAIGN_FILE, root or folder
    if leads_out(path, root):
        raise PathError(f"{path} is a link to a place outside {root}; copy the file into the folder")
    if path.exists():
        return read_campaign(path)
    return CampaignText(path, "\n".join(draft_lines(scan_folder(folder, within=root), Asker(None))) + "\n", None)


def read_campaign(path: Path) -> CampaignText:
    """Read a campaign file."""
    try:
        text = _read(path)
        tomllib.loads(text)
        tomlkit.parse(text)
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, TOMLKitError) as error:
        raise CampaignTextError(
            f"{path}: this is not TOML ({error}); correct it in an editor, or move it away"
        ) from None
    return CampaignText(path, text, text)


def _read(path: Path) -> str:
    """Return the text of a file with its line endings as they are."""
    return path.read_bytes().decode("utf-8")


def _write(path: Path, text: str) -> None:
    write_atomically(path, lambda part: part.write_bytes(text.encode("utf-8")))


def _uncommented(text: str, tables: Sequence[str], name: str) -> str:
    """Return a drafted text in which the example of a key in a comment of its table is written as the key itself."""
    if not text.startswith(DRAFTED):
        return text
    header, example = f"[{'.'.join(tables)}]", f"# {name} = "
    lines, inside = text.splitlines(keepends=True), False
    for index, line in enumerate(lines):
        if line.startswith("["):
            inside = line.startswith(header)
        if inside and line.startswith(f"{name} = "):
            return text
        if inside and line.startswith(example):
            with suppress(tomllib.TOMLDecodeError):
                tomllib.loads(line.removeprefix("# "))
                return "".join([*lines[:index], line.removeprefix("# "), *lines[index + 1 :]])
    return text


def _set(table: Any, name: str, value: object) -> None:
    """Set, replace or take away one key."""
    if value is None:
        del table[name]
    elif isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
        entries = tomlkit.aot()
        for item in value:
            entry = tomlkit.table()
            entry.update(item)
            entry.add(tomlkit.nl())
            entries.append(entry)
        table[name] = entries
    elif isinstance(value, list) and isinstance(table.get(name), Array) and len(table[name]) == len(value):
        # Item by item: comments between them stay.
        for index, item in enumerate(value):
            if table[name][index] != item:
                table[name][index] = item
    else:
        table[name] = value


def _without_marks(found: Any) -> Any:
    """Return a value with None in place of every mark of what has to be filled in."""
    if isinstance(found, dict):
        return {name: _without_marks(value) for name, value in found.items()}
    if isinstance(found, list):
        return [_without_marks(item) for item in found]
    return None if found == TO_FILL else found
