"""Provenance of a run: versions, inputs with their SHA-256, parameters, times, and the command; and whether a run is there already."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from fusion.campaign.config import Campaign
from fusion.effects.plugins import GROUP, describe_code, plugins
from fusion.products.progress import Report, silent
from fusion.products.results import Notice, Results, read_results
from fusion.products.store import OutputError, StageStamps, digest, file_sha256, is_file_list, read_json_object
from thermography.io.frame_readers import ENTRY_POINT_GROUP

#: Number of the products' layout: stages that were kept in another one are computed again.
PRODUCT_LAYOUT = 5
#: The stamp of a whole run, which its last stage gets.
_REPORT = "report"

#: Packages whose version can change a number in the results.
_PACKAGES = (
    "thermofuse", "numpy", "scipy", "xarray", "opencv-python-headless", "scikit-image", "numba", "imagecodecs", "OpenEXR",
    "GTC", "ref-index", "pandas", "h5netcdf", "netCDF4",
)  # fmt: skip


@cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of every package that takes part in the calculation."""
    installed = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            installed[name] = "not installed"
    return installed


def hash_files(files: Mapping[str, Path], *, report: Report = silent) -> dict[str, dict[str, Any]]:
    """Return size and SHA-256 of each file.

    Parameters
    ----------
    files : mapping of str to Path
        Inputs by their name relative to the campaign file, or products by theirs in the results folder.
    report : callable
        ``report(label, done, total)``, for progress through the inputs.

    Returns
    -------
    dict
        ``bytes`` and ``sha256`` by name.
    """
    hashed = {}
    for done, (name, path) in enumerate(files.items()):
        report("input files", done, len(files))
        hashed[name] = {"bytes": path.stat().st_size, "sha256": file_sha256(path)}
    report("input files", len(files), len(files))
    return hashed


def dependencies() -> tuple[int, dict[str, str], list[dict[str, Any]]]:
    """Return what every product depends on beside campaign and files: its layout, the versions, and the plug-ins with their code."""
    groups = [*([GROUP] if plugins() else []), ENTRY_POINT_GROUP]
    added = [plugin for group in groups for plugin in describe_code(group)]
    for plugin in added:
        plugin["code"] = [file_sha256(path) for path in plugin["code"]]
    return PRODUCT_LAYOUT, versions(), added


def stamp_run(
    stamps: StageStamps, campaign: Campaign, inputs: Mapping[str, Mapping[str, Any]], products: Sequence[Path]
) -> None:
    """Stamp that a run is whole, so that `kept_results` knows it again.

    Parameters
    ----------
    stamps : StageStamps
        Of the results folder.
    campaign : Campaign
        What was run.
    inputs : mapping
        Result of `hash_files`, from before the run.
    products : sequence of Path
        Everything that the run wrote or kept.
    """
    stamps.record(_REPORT, _run_key(campaign), products, {"inputs": inputs})


def kept_results(campaign: Campaign, folder: Path) -> Results | None:
    """Return the results of a whole run of the same campaign from the same input, or None where anything has to be done.

    Parameters
    ----------
    campaign : Campaign
        What is to be run.
    folder : Path
        Results folder.

    Notes
    -----
    The campaign file's content, the files that its patterns find and their SHA-256, the versions and every product's SHA-256 must be those
    of the stamp. What is cheap to compare is compared first; a product or an input that was touched but holds the same is the same.
    """
    stamps = StageStamps(folder)
    if not stamps.done(_REPORT, _run_key(campaign)):
        return None
    noted, files = stamps.note(_REPORT)["inputs"], campaign.input_files()
    sizes = {name: path.stat().st_size for name, path in files.items() if path.is_file()}
    if sizes != {name: known["bytes"] for name, known in noted.items()} or hash_files(files) != noted:
        return None
    return read_results(folder)


def forget_run(stamps: StageStamps) -> None:
    """Take the stamp of a whole run away, before its products are written anew.

    Parameters
    ----------
    stamps : StageStamps
        Of the results folder.
    """
    stamps.forget(_REPORT)


def _run_key(campaign: Campaign) -> str:
    return digest(_REPORT, dependencies(), campaign.model_dump(mode="json", exclude={"path"}))


@dataclass(frozen=True)
class FileState:
    """What tells without reading a file whether it was changed.

    Attributes
    ----------
    size : int
        Bytes.
    changed_ns : int
        Time of the last change, ns.
    """

    size: int
    changed_ns: int


def input_states(campaign: Campaign) -> dict[str, FileState]:
    """Return size and time of change of every input that there is, keyed by its name relative to the campaign file.

    Parameters
    ----------
    campaign : Campaign
        Its patterns are matched anew.
    """
    states = {}
    for name, path in campaign.input_files().items():
        try:
            found = path.stat()
        except FileNotFoundError:
            continue
        states[name] = FileState(found.st_size, found.st_mtime_ns)
    return states


def note_changes(before: Mapping[str, FileState], after: Mapping[str, FileState]) -> list[Notice]:
    """Return a notice of the inputs that were added, removed or changed while a run read them, or none.

    Parameters
    ----------
    before, after : mapping
        Results of `input_states` at the start and at the end of the run.
    """
    parts = {
        "changed": [name for name in before if name in after and before[name] != after[name]],
        "removed": [name for name in before if name not in after],
        "added": [name for name in after if name not in before],
    }
    words = [f"{len(names)} {what} ({_some(names)})" for what, names in parts.items() if names]
    if not words:
        return []
    message = f"Input files were altered while the run read them: {'; '.join(words)}. Its products may mix two states of them."
    return [Notice("inputs_changed", message, "Wait until the recording has ended and run again.")]


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def refuse_other_campaign(folder: Path, campaign: Campaign, inputs: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse a results folder that holds the results of another campaign: a run that goes on there would replace them.

    Parameters
    ----------
    folder : Path
        Results folder.
    campaign : Campaign
        What is to be run.
    inputs : mapping
        Result of `hash_files`.

    Raises
    ------
    OutputError
        If the provenance of the folder names another campaign file, and none of the recordings of this one was an input then. A campaign
        file that was changed or moved, and recordings that have grown, are those of the same campaign.
    """
    known = read_json_object(folder / "provenance.json")
    here, there = _place_from(folder, campaign.path), known.get("campaign_file")
    if not is_file_list(known.get("inputs")) or not isinstance(there, str) or here in (None, there):
        return
    tables = ("thermography", "interferometry", "record")
    recordings = {inputs[name]["sha256"] for table in tables for name in campaign.files_of(table) if name in inputs}
    if recordings & {one["sha256"] for one in known["inputs"].values()}:
        return
    stated = known.get("parameters")
    about = stated.get("campaign") if isinstance(stated, dict) else None
    named = f'"{about.get("title")}", {there}' if isinstance(about, dict) else there
    raise OutputError(
        f"{folder} holds the results of another campaign ({named}), which --resume would replace by those of "
        f'{campaign.path} ("{campaign.campaign.title}"); name another folder with --out, or remove this one first'
    )


def describe_run(
    campaign: Campaign,
    inputs: Mapping[str, Mapping[str, Any]],
    folder: Path,
    *,
    started: datetime,
    seconds: Mapping[str, float],
    products: Iterable[Path] = (),
    address: str | None = None,
) -> dict[str, Any]:
    """Return the provenance of a run, without names of machine or user.

    Parameters
    ----------
    campaign : Campaign
        Stored as it was understood, with units in the names.
    inputs : mapping
        Result of `hash_files`.
    folder : Path
        Results folder.
    started : datetime
        Start of the run, UTC.
    seconds : mapping
        Wall time of each stage, s; 0 for a stage that was kept from an earlier run.
    products : iterable of Path
        What the run wrote for others to read; each is listed with its size and SHA-256.
    address : str or None
        Where the campaign file was fetched from; None for one of this machine.
    """
    named = {path.relative_to(folder).as_posix(): path for path in products}
    return {
        "software": "thermofuse",
        "versions": versions(),
        "command": [Path(sys.argv[0]).stem, *(_without_folder(argument) for argument in sys.argv[1:])],
        "campaign_file": _place_from(folder, campaign.path) if address is None else None,
        **({} if address is None else {"campaign_address": address}),
        "started": started.isoformat(timespec="seconds"),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "stage_seconds": {name: round(value, 2) for name, value in seconds.items()},
        "parameters": campaign.model_dump(mode="json", exclude={"path"}, exclude_none=True),
        "inputs": dict(inputs),
        "products": hash_files(named),
    }


def _place_from(folder: Path, campaign: Path) -> str | None:
    """Return the campaign file as seen from the results folder, or None where the way would name folders of the user."""
    try:
        way = Path(os.path.relpath(campaign, folder.resolve()))
    except ValueError:  # another drive
        return None
    return way.as_posix() if way.parts.count("..") <= 1 and len(way.parts) <= 3 else None


def _without_folder(argument: str) -> str:
    """Return a command-line argument without the folders of an absolute path, which belong to one machine only."""
    return Path(argument).name if Path(argument).is_absolute() else argument
