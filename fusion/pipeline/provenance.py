"""Provenance of a run: versions, inputs with their SHA-256, parameters, times, and the command."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from fusion.campaign.config import Campaign
from fusion.products.progress import Report, silent
from fusion.products.store import file_sha256

#: Packages whose version can change a number in the results.
_PACKAGES = (
    "thermofuse", "numpy", "scipy", "xarray", "opencv-python-headless", "scikit-image", "numba", "imagecodecs", "OpenEXR",
    "GTC", "ref-index", "pandas", "h5netcdf",
)  # fmt: skip


def versions() -> dict[str, str]:
    """Return the versions of Python and of every package that takes part in the calculation."""
    installed = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            installed[name] = "not installed"
    return installed


def hash_inputs(files: Mapping[str, Path], *, report: Report = silent) -> dict[str, dict[str, Any]]:
    """Return size and SHA-256 of each input, keyed by its name relative to the campaign file.

    Parameters
    ----------
    files : mapping of str to Path
        Files by their name relative to the campaign file.
    report : callable
        ``report(label, done, total)``, for progress.

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


def describe_run(
    campaign: Campaign, inputs: Mapping[str, Mapping[str, Any]], *, started: datetime, seconds: Mapping[str, float]
) -> dict[str, Any]:
    """Return the provenance of a run, without names of machine or user.

    Parameters
    ----------
    campaign : Campaign
        Stored as it was understood, with units in the names.
    inputs : mapping
        Result of `hash_inputs`.
    started : datetime
        Start of the run, UTC.
    seconds : mapping
        Wall time of each stage, s; 0 for a stage that was kept from an earlier run.
    """
    return {
        "software": "thermofuse",
        "versions": versions(),
        "command": [Path(sys.argv[0]).stem, *(_without_folder(argument) for argument in sys.argv[1:])],
        "started": started.isoformat(timespec="seconds"),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "stage_seconds": {name: round(value, 2) for name, value in seconds.items()},
        "parameters": campaign.model_dump(mode="json", exclude={"path"}, exclude_none=True),
        "inputs": dict(inputs),
    }


def _without_folder(argument: str) -> str:
    """Return a command-line argument without the folders of an absolute path, which belong to one machine only."""
    return Path(argument).name if Path(argument).is_absolute() else argument
