"""What was recognised in a folder, with its warnings, in the words of `thermofuse inspect`."""

from __future__ import annotations

from pathlib import Path

import panel as pn

from fusion.app.elements import heading, paragraph, table
from fusion.starting.inspection import Inspected, inspect_paths
from fusion.starting.kinds import Kind


def found_in_folder(folder: Path) -> list[pn.viewable.Viewable]:
    """Return what a folder holds, as parts of a screen.

    Parameters
    ----------
    folder : Path
        An existing folder; its subfolders are looked into, without hidden files and results.

    Returns
    -------
    list of Viewable
        A table of files and series, then a warning or a fault per file that has one, and per campaign file of a folder below.
    """
    looked_into = list(inspect_paths([folder]))
    if [one.label for one in looked_into] == [str(folder)]:
        return [paragraph(f"{folder} holds no file; put the files of the measurement into it", kind="fault")]
    usable = [one for one in looked_into if not one.fault]
    parts = [heading("What was recognised", level=3)]
    if usable:
        rows = [(name_in(folder, one), one.kind.value, content_of(one)) for one in usable]
        parts.append(table(("file or series", "kind", "content"), rows, caption=f"Files in {folder}", stacked=True))
    for one in looked_into:
        name = name_in(folder, one)
        if one.kind is Kind.CAMPAIGN and Path(name).parent != Path():
            told = f"{name} is the campaign file of a folder below; to open it, look into {folder / Path(name).parent}"
            parts.append(paragraph(told, kind="warning"))
        parts += [paragraph(f"{name}: {line}", kind="warning") for line in warnings_of(one)]
        if one.fault:
            parts.append(paragraph(f"{name} is not used: {one.fault}", kind="fault" if one.fails else "warning"))
    return parts


def name_in(folder: Path, one: Inspected) -> str:
    """Return the name of a file or a series within its folder.

    Parameters
    ----------
    folder : Path
        That was looked into.
    one : Inspected
        A file or a series in it.
    """
    return one.label.removeprefix(str(folder)).lstrip("/\\")


def content_of(one: Inspected) -> str:
    """Return what a file holds as sentences on one line, without its path and its warnings.

    Parameters
    ----------
    one : Inspected
        A file that can be used.
    """
    first, *rest = one.lines
    told = [first.removeprefix(one.label).lstrip(": "), *rest]
    return "; ".join(line.strip() for line in told if not line.startswith("  warning"))


def warnings_of(one: Inspected) -> list[str]:
    """Return the warnings of a file without the word.

    Parameters
    ----------
    one : Inspected
        A file or a series.
    """
    return [line.strip().removeprefix("warning: ") for line in one.lines if line.startswith("  warning")]
