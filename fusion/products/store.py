"""Products on disk: written whole or not at all, described by the CF conventions, and stamped so that a finished stage is kept.

xarray, which takes a third of a second to load, is loaded with the first NetCDF file: a finished run is recognised without it.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard, TypeVar

import numpy as np

from fusion.errors import FusionError
from thermography._hdf5 import hdf5_fault
from thermography.fields.tasks.pieces import in_pieces
from thermography.fields.tasks.spool import IN_MEMORY_BYTES
from thermography.io import atomic

if TYPE_CHECKING:
    import xarray as xr

_STAMPS = ".stages/stamps.json"
#: Compressed maps are stored in parts of this size, bytes: one cycle of thousands can be read without the others.
_CHUNK_BYTES = 1 << 21
#: A product is one Dataset, or a tree of them whose nodes become the groups of one NetCDF file.
Product = TypeVar("Product", "xr.Dataset", "xr.DataTree")


class OutputError(FusionError):
    """A results folder that cannot be written to; the message says what to do."""


class DamagedProductError(FusionError):
    """A product that is not what a run wrote; the message names the file and says what to do."""


def write_atomically(path: Path, write: Callable[[Path], object]) -> Path:
    """Write a product whole or not at all, see `thermography.io.atomic.write_atomically`.

    Parameters
    ----------
    path : Path
        Product; its folder is created where it is absent.
    write : callable
        Writes the whole product to the path that it is given.

    Returns
    -------
    Path
        The product.

    Raises
    ------
    OutputError
        If the folder cannot be written to or the disk is full; the old product is untouched.
    """
    try:
        return atomic.write_atomically(path, write)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(
            f"{path}: cannot be written ({reason}); what was written before is whole: make room or allow writing there and start again, "
            "a run with --resume, or name another folder with --out"
        ) from error


def is_text(name: str) -> bool:
    """Return whether the name of a file is text: others cannot be written into results.

    Parameters
    ----------
    name : str
        As the system gives it, with halves of characters in place of bytes that are no UTF-8.
    """
    return not any("\ud800" <= character <= "\udfff" for character in name)


def write_text(path: Path, text: str) -> Path:
    """Write UTF-8 text whole or not at all.

    Parameters
    ----------
    path : Path
        Product.
    text : str
        Its whole content.
    """
    return write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_json(path: Path, content: object) -> Path:
    """Write JSON whole or not at all; numbers that are not finite become null, as JSON has no word for them.

    Parameters
    ----------
    path : Path
        Product.
    content : object
        Anything that `plain` can express.
    """
    return write_text(path, json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def write_dataset(path: Path, product: xr.Dataset | xr.DataTree) -> Path:
    """Write a product as NetCDF 4 whole or not at all; floating-point maps are compressed without loss.

    Every node of a tree becomes a group with coordinates of its own, so that ``xarray.open_dataset(path, group=...)`` needs no other
    group to make sense of it.

    Parameters
    ----------
    path : Path
        Product.
    product : Dataset or DataTree
        Described with `annotate`.

    Raises
    ------
    OutputError
        If the folder cannot be written to, or its disk has not the room that the product may take.
    """
    import netCDF4
    import xarray as xr
    from xarray.backends import NetCDF4DataStore
    from xarray.backends.common import ArrayWriter

    class PieceWriter(ArrayWriter):
        """Writes an array that is in a mapped file piece by piece, so that it need not be in memory."""

        def add(self, source: Any, target: Any, region: Any = None) -> None:
            if source.nbytes <= IN_MEMORY_BYTES:
                super().add(source, target, region)
                return
            for some, piece in in_pieces(source):
                target[some] = piece

    tree = xr.DataTree(product) if isinstance(product, xr.Dataset) else product
    _require_room(path, sum(node.to_dataset().nbytes for node in tree.subtree))

    def write_groups(temporary: Path) -> None:
        # The library of netCDF writes many small variables three times as fast as h5netcdf; both write the same. Into a file that is
        # open: `Dataset.to_netcdf` opens it for every group, and loads what a cluster needs.
        # Its memory for each variable, 64 MB unless told, holds one part.
        netCDF4.set_chunk_cache(_CHUNK_BYTES)
        with netCDF4.Dataset(temporary, "w") as file:
            for node in tree.subtree:
                dataset = _with_own_coordinates(node).load()
                group = file if node is tree else file.createGroup(node.relative_to(tree))
                dataset.dump_to_store(NetCDF4DataStore(group), encoding=_encoding(dataset), writer=PieceWriter())

    return write_atomically(path, write_groups)


def _require_room(path: Path, most_bytes: int) -> None:
    """Refuse to write where a disk is almost full: HDF5 ends the process when it cannot close a file for want of room.

    `most_bytes` is what the values take without compression; the file's own tables are less than a tenth and a megabyte more.
    """
    folder = next(folder for folder in path.absolute().parents if folder.exists())
    needed, free = int(1.1 * most_bytes) + 1_000_000, shutil.disk_usage(folder).free
    if free < needed:
        raise OutputError(
            f"{path}: may take {needed / 1e6:.0f} MB, and the disk has {free / 1e6:.0f} MB left; what was written before is whole: make "
            "room and start again, a run with --resume, or name another folder with --out"
        )


def _with_own_coordinates(node: xr.DataTree) -> xr.Dataset:
    """Return a node with the coordinates that it inherits, as far as its variables have their dimensions."""
    own = node.to_dataset(inherit=False)
    inherited = node.to_dataset().coords
    return own.assign_coords({name: inherited[name] for name in own.dims if name in inherited and name not in own})


def _encoding(dataset: xr.Dataset) -> dict[Any, dict[str, object]]:
    """Return the encoding of a Dataset: coordinates without fill value, large maps compressed."""
    encoding: dict[Any, dict[str, object]] = {name: {"_FillValue": None} for name in dataset.coords}
    for name, array in dataset.data_vars.items():
        if array.dtype.kind == "f" and array.size > 10_000:
            encoding[name] = {"zlib": True, "complevel": 1, "chunksizes": _chunks(array)}
    return encoding


def _chunks(array: xr.DataArray) -> tuple[int, ...]:
    """Return the shape of the parts in which a map is stored: whole fields, as many as there is room for."""
    field = array.dtype.itemsize * math.prod(array.shape[1:])
    return (max(1, min(array.shape[0], _CHUNK_BYTES // field)), *array.shape[1:])


def is_large(dataset: xr.Dataset) -> bool:
    """Return whether a Dataset holds an array that `open_dataset` leaves in its file.

    Parameters
    ----------
    dataset : Dataset
        Product.
    """
    return any(variable.nbytes > IN_MEMORY_BYTES for variable in dataset.variables.values())


def open_dataset(path: Path) -> xr.Dataset:
    """Open a Dataset written by `write_dataset`: arrays of more than 8 MB stay in the file, the others are read into memory.

    Parameters
    ----------
    path : Path
        Product.

    Returns
    -------
    Dataset
        What is asked for of a large array, for example some cycles, is read then, and not kept, see `open_in_file`.

    Raises
    ------
    DamagedProductError
        If the file is no NetCDF, or only a part of one.
    FileNotFoundError
        If there is none.
    """
    opened = open_in_file(path)
    try:
        for variable in opened.variables.values():
            if variable.nbytes <= IN_MEMORY_BYTES:
                variable.load()
    except DamagedProductError:
        opened.close()
        raise
    if not is_large(opened):
        opened.close()
    return opened


def open_in_file(path: Path) -> xr.Dataset:
    """Open a Dataset written by `write_dataset` and leave all its arrays in the file.

    Parameters
    ----------
    path : Path
        Product.

    Returns
    -------
    Dataset
        What is asked for is read then, and not kept; it is of the file that was opened, whatever takes its place meanwhile. Bytes that
        turn out to be damaged only then raise `DamagedProductError`, too.

    Raises
    ------
    DamagedProductError
        If the file is no NetCDF, or only a part of one.
    FileNotFoundError
        If there is none.
    """
    from thermography.fields.tasks.stored import open_stored

    with told_if_damaged(path):
        # Of every array one part is kept, which the next piece may need, in place of several.
        return open_stored(path, partial(_named_if_damaged, path), _CHUNK_BYTES)


def read_dataset(path: Path) -> xr.Dataset:
    """Read a Dataset written by `write_dataset` into memory.

    Parameters
    ----------
    path : Path
        Product.

    Raises
    ------
    DamagedProductError
        If the file is no NetCDF, or only a part of one.
    FileNotFoundError
        If there is none.
    """
    import xarray as xr

    with told_if_damaged(path), xr.open_dataset(path, engine="h5netcdf", decode_timedelta=False) as dataset:
        return dataset.load()


def read_tree(path: Path) -> xr.DataTree:
    """Read a tree written by `write_dataset` into memory.

    Parameters
    ----------
    path : Path
        Product.

    Raises
    ------
    DamagedProductError
        If the file is no NetCDF, or only a part of one.
    FileNotFoundError
        If there is none.
    """
    import xarray as xr

    with told_if_damaged(path), xr.open_datatree(path, engine="h5netcdf", decode_timedelta=False) as tree:
        return tree.load()


@contextmanager
def told_if_damaged(path: Path) -> Iterator[None]:
    """Name the file where reading a product fails.

    Parameters
    ----------
    path : Path
        Product that is read within.

    Raises
    ------
    DamagedProductError
        If its values stand in another file or nowhere, or the library of NetCDF cannot read it: HDF5 answers to damaged bytes with errors
        of several kinds, none of which names the file.
    """
    with _named_if_damaged(path):
        fault = hdf5_fault(path)
        if fault:
            raise DamagedProductError(f"{path}: is no product of thermofuse: {fault}; run the campaign again")
        yield


@contextmanager
def _named_if_damaged(path: Path) -> Iterator[None]:
    """Name the file where the library of NetCDF cannot read it."""
    try:
        yield
    except (FileNotFoundError, IsADirectoryError, PermissionError, FusionError):
        raise
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
        raise DamagedProductError(
            f"{path}: is damaged or no product of thermofuse ({type(error).__name__}); run the campaign again"
        ) from error


def plain(value: Any) -> Any:
    """Return `value` in JSON's own types: arrays as lists, NumPy scalars as numbers, times as ISO text, NaN as None.

    Parameters
    ----------
    value : object
        Mappings, sequences, arrays, NumPy scalars, times (UTC), paths, or JSON's own types.
    """
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.datetime64):
        return None if np.isnat(value) else f"{np.datetime_as_string(value, unit='ms')}Z"
    if isinstance(value, np.ndarray):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return value.as_posix()
    return value


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file as hexadecimal text.

    Parameters
    ----------
    path : Path
        File of any size.
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def digest(*parts: object) -> str:
    """Return one SHA-256 over anything that `plain` can express; equal input gives equal text on every machine.

    Parameters
    ----------
    *parts : object
        Anything that `plain` can express.
    """
    text = json.dumps(plain(parts), sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


class StageStamps:
    """Stages of a run that are done, with their input and their files; stored in the results folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = folder / _STAMPS
        self._stamps: dict[str, dict[str, Any]] = {}
        # Without stamps, or with damaged ones, nothing is known to be done.
        with suppress(FileNotFoundError, ValueError):
            self._stamps = json.loads(self._path.read_text(encoding="utf-8"))

    def done(self, stage: str, key: str) -> bool:
        """Tell whether `stage` was finished from input `key` and its files are still as they were written."""
        stamp = self._stamps.get(stage)
        if stamp is None or stamp["key"] != key:
            return False
        return all(
            (self._folder / name).is_file() and file_sha256(self._folder / name) == sha
            for name, sha in stamp["files"].items()
        )

    def note(self, stage: str) -> Any:
        """Return what was noted when `stage` was recorded."""
        return self._stamps[stage]["note"]

    def forget(self, stage: str) -> None:
        """Remove the stamp of `stage`, where there is one, before its files are written anew."""
        if self._stamps.pop(stage, None) is not None:
            write_json(self._path, self._stamps)

    def record(self, stage: str, key: str, files: Iterable[Path], note: object) -> None:
        """Stamp that `stage` is done from input `key` and wrote `files`; `note` is its share of results.json."""
        names = {path.relative_to(self._folder).as_posix(): file_sha256(path) for path in files}
        self._stamps[stage] = {"key": key, "files": names, "note": plain(note)}
        write_json(self._path, self._stamps)


def read_json_object(path: Path) -> dict[str, Any]:
    """Return what a JSON file holds by name, empty where it is absent, damaged, or holds no such thing.

    Parameters
    ----------
    path : Path
        File of a results folder that is looked into without claim to be whole.
    """
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, RecursionError):
        return {}


def require_own(folder: Path, names: Iterable[str]) -> None:
    """Refuse products that are not the files which the run of a folder wrote.

    Parameters
    ----------
    folder : Path
        Results folder; a run without ``products`` in its ``provenance.json`` is taken as it is.
    names : iterable of str
        Files in it; one that is absent is no matter of this check.

    Raises
    ------
    DamagedProductError
        If the SHA-256 of one differs from that in ``provenance.json``.
    """
    written = read_json_object(folder / "provenance.json").get("products")
    known: dict[str, Any] = written if is_file_list(written) else {}
    for name in names:
        path = folder / name
        if name in known and path.is_file() and file_sha256(path) != known[name]["sha256"]:
            raise DamagedProductError(
                f"{path}: is not the file that this run wrote (its SHA-256 is not that of provenance.json); put that file back, or run the "
                "campaign again"
            )


def is_file_list(content: object) -> TypeGuard[dict[str, Any]]:
    """Return whether JSON is a list of files as a provenance holds it: by name, with ``bytes`` and ``sha256`` of each.

    Parameters
    ----------
    content : object
        ``inputs`` or ``products`` of a provenance.json.
    """
    return isinstance(content, dict) and all(
        isinstance(one, dict) and {"bytes", "sha256"} <= one.keys() for one in content.values()
    )


def finished_stages(folder: Path) -> list[str]:
    """Return the stages of a run that a results folder holds, in the order in which they were finished.

    Parameters
    ----------
    folder : Path
        Results folder.
    """
    return list(read_json_object(folder / _STAMPS))


def noted_messages(folder: Path) -> list[dict[str, Any]]:
    """Return the notices of the finished stages of a run, also while it is under way.

    Parameters
    ----------
    folder : Path
        Results folder.

    Returns
    -------
    list of dict
        As in ``warnings`` of results.json, in the order in which the stages were finished.
    """
    stamps = read_json_object(folder / _STAMPS)
    return [notice for stamp in stamps.values() for notice in (stamp.get("note") or {}).get("notices", [])]


_CONVENTIONS = "CF-1.11"
#: What `annotate` writes for the whole file.
GLOBAL_ATTRIBUTES = ("Conventions", "title", "history", "provenance")


def annotate(product: Product, *, title: str, history: str, provenance: Mapping[str, Any]) -> Product:
    """Return `product` with the global attributes of the CF conventions and a long name wherever none was given.

    Parameters
    ----------
    product : Dataset or DataTree
    title : str
        Title of the campaign.
    history : str
        When and by which command the file was made.
    provenance : mapping
        Stored as one JSON text, since NetCDF attributes hold neither mappings nor None.
    """
    import xarray as xr

    described = product.copy()
    for node in described.subtree if isinstance(described, xr.DataTree) else (described,):
        for name, variable in node.variables.items():
            if "long_name" not in variable.attrs and "standard_name" not in variable.attrs:
                variable.attrs["long_name"] = name_in_words(str(name))
    described.attrs = {
        **product.attrs,
        "Conventions": _CONVENTIONS,
        "title": title,
        "history": history,
        "provenance": json.dumps(provenance, sort_keys=True),
    }
    return described


def name_in_words(name: str) -> str:
    """Return a variable's name as words: ``"drift_profile_u"`` -> ``"standard uncertainty of drift profile"``.

    Parameters
    ----------
    name : str
        Name of a variable; ``_u`` at its end stands for a standard uncertainty.
    """
    words = name.removesuffix("_u").replace("_", " ")
    return f"standard uncertainty of {words}" if name.endswith("_u") else words
