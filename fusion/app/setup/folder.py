"""What was recognised in a folder, in the words of `thermofuse inspect`; files that are dropped on the page go into it."""

from __future__ import annotations

from pathlib import Path

import panel as pn

from fusion.app.parts import PathError, allowed_folder, allowed_path, file_name, heading, paragraph, table
from fusion.campaign.inspect import Inspected, Kind, inspect_paths, leads_out
from fusion.common import FusionError
from fusion.results.store import write_atomically


def found_in_folder(folder: Path, root: Path | None = None) -> list[pn.viewable.Viewable]:
    """Return what a folder holds, as parts of a screen; links out of `root`, else of the folder, are named and not followed."""
    root = root or folder
    looked_into = list(inspect_paths([folder], within=root))
    if [one.label for one in looked_into] == [str(folder)]:
        return [paragraph(f"{folder} holds no file; put the files of the measurement into it", kind="fault")]
    usable = [one for one in looked_into if not one.fault]
    parts = [heading("What was recognised", level=3)]
    if usable:
        rows = [(name_in(folder, one), one.kind.value.words, "; ".join(one.content)) for one in usable]
        parts.append(table(("file or series", "kind", "content"), rows, caption=f"Files in {folder}", stacked=True))
    for one in looked_into:
        name = name_in(folder, one)
        if one.kind is Kind.CAMPAIGN and Path(name).parent != Path():
            told = f"{name} is the campaign file of a folder below; to open it, look into {folder / Path(name).parent}"
            parts.append(paragraph(told, kind="warning"))
        parts += [paragraph(f"{name}: {line.removeprefix('warning: ')}", kind="warning") for line in one.warnings]
        if one.fault:
            parts.append(paragraph(f"{name} is not used: {one.fault}", kind="fault" if one.fails else "warning"))
    for path in sorted(folder.iterdir()):
        if leads_out(path, root):
            told = f"{path.name} is a link to a place outside {root} and is not followed; copy what it leads to into the folder"
            parts.append(paragraph(told, kind="warning"))
    return parts


def name_in(folder: Path, one: Inspected) -> str:
    """Return the name of a file or a series within its folder."""
    return one.label.removeprefix(str(folder)).lstrip("/\\")


# Files that are dropped on the page.

#: Largest file that is taken, MB: it passes through the memory of the browser and of the application.
LARGEST_MB = 100


class UploadError(FusionError):
    """A file that is not taken; the message says why and what to do."""


def store_upload(root: Path, folder: Path, name: str, content: bytes | str) -> Path:
    """Write a file that was dropped on the page."""
    inside = allowed_folder(root, folder)
    data = content.encode("utf-8") if isinstance(content, str) else content
    if len(data) > LARGEST_MB * 1_000_000:
        raise UploadError(f"{name} is larger than {LARGEST_MB} MB; copy it into {inside} with the file manager")
    path = allowed_path(root, inside / file_name(name))
    if path.parent != inside:
        raise PathError(f"{name} leads out of {inside}; give the file a name without folders")
    if path.exists():
        raise UploadError(f"{path} exists already and is not replaced; give the file another name")
    return write_atomically(path, lambda part: part.write_bytes(data))
