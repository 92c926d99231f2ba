"""A second results folder that starts from what a first one has finished: for a campaign in which a little was changed."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from fusion.products.folder import MANIFEST, read_manifest
from fusion.products.store import OutputError, finished_stages

_STAGES = ".stages"
#: What belongs to one run of one folder, and not to its products.
_OWN = {"lock", "holder.json"}


def branch_results(finished: Path, branch: Path) -> list[str]:
    """Give a new results folder the products of a finished one, so that a run with ``resume`` computes only what changed.

    Parameters
    ----------
    finished : Path
        Results folder of a finished run; it is only read.
    branch : Path
        The new folder; must be absent.

    Returns
    -------
    list of str
        Stages that it holds.

    Raises
    ------
    OutputError
        If the new folder exists, or cannot be written to.

    Notes
    -----
    Files are shared (hard links) where the file system allows it, else copied: a run never writes into a product, it puts a new file in
    its place, so that the finished folder stays as it is.
    """
    written = read_manifest(finished)
    stages = finished / _STAGES
    kept = [path for path in stages.glob("*") if path.is_file() and path.name not in _OWN]
    files = [finished / MANIFEST, *kept, *(finished / name for name in written)]
    try:
        branch.mkdir(parents=True)
        for path in files:
            if path.is_file():
                _share(path, branch / path.relative_to(finished))
    except FileExistsError:
        raise OutputError(f"{branch} exists; name another folder for the new results") from None
    except OSError as error:
        raise OutputError(
            f"{branch}: cannot be written to ({error.strerror or error}); make room or allow it"
        ) from error
    return finished_stages(branch)


def _share(path: Path, copy: Path) -> None:
    """Make a second name for a file, or a copy of it where there can be no second name."""
    copy.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(path, copy)
    except OSError:
        shutil.copy2(path, copy)
