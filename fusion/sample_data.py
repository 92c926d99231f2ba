"""Public measured files: what `data/registry.csv` lists, fetched once and held to their SHA-256."""

from __future__ import annotations

import csv
import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import pooch

from fusion.errors import FusionError

REGISTRY = Path(__file__).resolve().parents[1] / "data" / "registry.csv"
#: Names a folder that holds the files under their registry names; then nothing is downloaded.
FOLDER_VARIABLE = "THERMOFUSE_DATA"


class DatasetError(FusionError):
    """A measured file that is not listed, not there, or not what the registry promises."""


@dataclass(frozen=True)
class Dataset:
    """A public measured file: where it is published, its SHA-256, its size in bytes, its licence and what it holds."""

    name: str
    address: str
    sha256: str
    size: int
    licence: str
    what: str


def read_registry(path: Path = REGISTRY) -> dict[str, Dataset]:
    """Return the listed files by name.

    Parameters
    ----------
    path : Path
        CSV with name, address, sha256, bytes, licence, what.

    Raises
    ------
    DatasetError
        Where the registry is not there, as in an installation without the repository.
    """
    if not path.exists():
        raise DatasetError(f"{path}: no registry of measured files; use a clone of the repository")
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        row["name"]: Dataset(row["name"], row["address"], row["sha256"], int(row["bytes"]), row["licence"], row["what"])
        for row in rows
    }


def fetch(name: str, *, registry: Path = REGISTRY) -> Path:
    """Return the local path of a public measured file, downloading it once where no local folder is named.

    Parameters
    ----------
    name : str
        As in the registry, for example ``gtatters__Thermimage/inst/extdata/IR_2412.jpg``.
    registry : path

    Returns
    -------
    Path
        In the folder of the environment variable THERMOFUSE_DATA where that is set, else in the user's cache.

    Raises
    ------
    DatasetError
        Where the name is not listed, the local folder does not hold it, the file has another SHA-256, or it cannot be downloaded.
    """
    listed = read_registry(registry)
    if name not in listed:
        raise DatasetError(
            f"{name!r} is not listed in {registry}; the first of {len(listed)} names is {next(iter(listed))!r}"
        )
    dataset = listed[name]
    folder = os.environ.get(FOLDER_VARIABLE)
    if folder:
        return _local(Path(folder) / name, dataset)
    target = pooch.os_cache("thermofuse") / name
    try:
        found = pooch.retrieve(dataset.address, f"sha256:{dataset.sha256}", fname=target.name, path=target.parent)
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{name}: could not be fetched from {dataset.address} ({error}); "
            f"copy the file by hand and name its folder in {FOLDER_VARIABLE}"
        ) from error
    return Path(found)


def _local(path: Path, dataset: Dataset) -> Path:
    """Return a file of the local folder after comparing its hash."""
    if not path.exists():
        raise DatasetError(
            f"{path} does not exist; {FOLDER_VARIABLE} must name a folder with the files under registry names"
        )
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != dataset.sha256:
        raise DatasetError(f"{path}: SHA-256 is {digest}, the registry promises {dataset.sha256}; fetch the file again")
    return path
