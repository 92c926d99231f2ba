"""Products on disk: written whole or not at all, described by the CF conventions, and stamped so that a finished stage is kept.

xarray, which takes a third of a second to load, is loaded with the first NetCDF file: a finished run is recognised without it.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard, TypeVar
from unicodedata import is_normalized

import numpy as np
from pydantic import BaseModel

from fusion.common import FusionError, own_name, place_within
from interferometry.common import DEVIATIONS, DIRECTIONS
from thermography.common import FIELDS
from thermography.io import files as atomic
from thermography.io.files import hdf5_fault
from thermography.large_arrays import IN_MEMORY_BYTES, in_pieces

if TYPE_CHECKING:
    import xarray as xr

_STAMPS = ".stages/stamps.json"
#: More than any JSON of a run, whose results and provenance with tens of thousands of files have some megabytes, bytes.
_MOST_JSON_BYTES = 100_000_000
#: Largest number of a JSON file: in any unit far beyond what is measured, and its square is still a number.
_LARGEST = 1e100
#: Compressed maps are stored in parts of this size, bytes: one cycle of thousands can be read without the others.
_CHUNK_BYTES = 1 << 21
#: How xarray opens a product: many small variables are read nine times as fast as with h5netcdf, with the same content.
_READING: Mapping[str, Any] = {"engine": "netcdf4", "decode_timedelta": False}
#: A product is one Dataset, or a tree of them whose nodes become the groups of one NetCDF file.
Product = TypeVar("Product", "xr.Dataset", "xr.DataTree")


class OutputError(FusionError):
    """A results folder that cannot be written to; the message says what to do."""


class DamagedProductError(FusionError):
    """A product that is not what a run wrote; the message names the file and says what to do."""


def write_atomically(path: Path, write: Callable[[Path], object]) -> Path:
    """Write a product whole or not at all, see `thermography.io.files.write_atomically`."""
    try:
        return atomic.write_atomically(path, write)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(
            f"{path}: cannot be written ({reason}); what was written before is whole: make room or allow writing there and start again, "
            "a run with --resume, or name another folder with --out"
        ) from error


def is_text(name: str) -> bool:
    """Return whether the name of a file is text: others cannot be written into results."""
    return not any("\ud800" <= character <= "\udfff" for character in name)


def write_text(path: Path, text: str) -> Path:
    """Write UTF-8 text whole or not at all."""
    return write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_json(path: Path, content: object) -> Path:
    """Write JSON whole or not at all; numbers that are not finite become null, as JSON has no word for them."""
    return write_text(path, json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def write_dataset(path: Path, product: xr.Dataset | xr.DataTree) -> Path:
    """Write a product as NetCDF 4 whole or not at all; floating-point maps are compressed without loss."""
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
        # Its memory for each variable, 64 MB unless set, holds one part.
        netCDF4.set_chunk_cache(_CHUNK_BYTES)
        with netCDF4.Dataset(temporary, "w") as file:
            for node in tree.subtree:
                dataset = _storable(_with_own_coordinates(node).load())
                group = file if node is tree else file.createGroup(node.relative_to(tree))
                dataset.dump_to_store(NetCDF4DataStore(group), encoding=_encoding(dataset), writer=PieceWriter())

    return write_atomically(path, write_groups)


def retitle(path: Path, attributes: Mapping[str, str]) -> bool:
    """Give a product other global attributes, the rest as it is, where it has not these already; tell whether it was written."""
    import netCDF4

    with refuse_damaged(path), netCDF4.Dataset(path) as file:
        if all(getattr(file, name, None) == text for name, text in attributes.items()):
            return False
    _require_room(path, path.stat().st_size)

    def write(temporary: Path) -> None:
        shutil.copyfile(path, temporary)
        with netCDF4.Dataset(temporary, "a") as file:
            file.setncatts(attributes)

    write_atomically(path, write)
    return True


def _require_room(path: Path, most_bytes: int) -> None:
    """Refuse to write where a disk is almost full: HDF5 ends the process when it cannot close a file for want of room."""
    folder = next(folder for folder in path.absolute().parents if folder.exists())
    needed, free = int(1.1 * most_bytes) + 1_000_000, shutil.disk_usage(folder).free
    if free < needed:
        raise OutputError(
            f"{path}: may take {needed / 1e6:.0f} MB, and the disk has {free / 1e6:.0f} MB left; what was written before is whole: make "
            "room and start again, a run with --resume, or name another folder with --out"
        )


def _with_own_coordinates(node: xr.DataTree) -> xr.Dataset:
    """Return a node with the coordinates that it inherits, as far as its variables have their dimensions."""
    own, inherited = node.to_dataset(inherit=False), node.to_dataset().coords
    return own.assign_coords({name: inherited[name] for name in own.dims if name in inherited and name not in own})


#: Names that a variable of NetCDF can have (netCDF-C, Users Guide, "Variables"), and the attribute with the name that it cannot.
_STORABLE = re.compile(r"\w([^/\x00-\x1f\x7f]{0,98}[^/\s\x00-\x1f\x7f])?")
_CALLED = "called"


def _storable(dataset: xr.Dataset) -> xr.Dataset:
    """Return a Dataset with names that NetCDF can store; columns of a log may be called anything, which an attribute then says."""
    names: dict[str, str] = {}
    for name in map(str, dataset.data_vars):
        if not (_STORABLE.fullmatch(name) and is_normalized("NFC", name)):
            short = re.sub(r"\W", "_", name)[:80]
            names[name] = own_name(f"column_{short}", {*map(str, dataset.variables), *names.values()})
    called = {name: dataset[name].assign_attrs({_CALLED: name}) for name in names}
    return dataset.assign(called).rename(names)


def _as_called(dataset: xr.Dataset) -> xr.Dataset:
    """Return a Dataset that was read with the names that it had before it was stored."""
    names = {
        name: variable.attrs.pop(_CALLED) for name, variable in dataset.variables.items() if _CALLED in variable.attrs
    }
    return dataset.rename(names)


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
    """Return whether a Dataset holds an array that `open_dataset` leaves in its file."""
    return any(variable.nbytes > IN_MEMORY_BYTES for variable in dataset.variables.values())


def open_dataset(path: Path) -> xr.Dataset:
    """Open a Dataset written by `write_dataset`: arrays of more than 8 MB stay in the file, the others are read into memory."""
    with opened(path) as small:
        if not is_large(small):
            return small.load()
    large = open_in_file(path)
    try:
        for variable in large.variables.values():
            if variable.nbytes <= IN_MEMORY_BYTES:
                variable.load()
    except DamagedProductError:
        large.close()
        raise
    return large


def open_in_file(path: Path) -> xr.Dataset:
    """Open a Dataset written by `write_dataset` and leave all its arrays in the file."""
    from thermography.fields.scheduling import open_stored

    with refuse_damaged(path):
        # Of every array one part is kept, which the next piece may need, in place of several.
        return open_stored(path, partial(_named_if_damaged, path), _CHUNK_BYTES)


def read_dataset(path: Path) -> xr.Dataset:
    """Read a Dataset written by `write_dataset` into memory."""
    with opened(path) as dataset:
        return _as_called(dataset.load())


def read_tree(path: Path) -> xr.DataTree:
    """Read a tree written by `write_dataset` into memory."""
    import xarray as xr

    # `DataTree.load` leaves a variable in the file that is called like a group: it would open it again, and never close it.
    with refuse_damaged(path), xr.open_datatree(path, **_READING) as tree:
        groups = {node.path: node.to_dataset(inherit=False).load() for node in tree.subtree}
    return xr.DataTree.from_dict({**groups, "/": _as_called(groups["/"])})


@contextmanager
def opened(path: Path) -> Iterator[xr.Dataset]:
    """Open the root of a product; what fails while it is read names the file."""
    import xarray as xr

    with refuse_damaged(path), xr.open_dataset(path, **_READING) as dataset:
        yield dataset


@contextmanager
def refuse_damaged(path: Path) -> Iterator[None]:
    """Name the file where reading a product fails."""
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
    except (OSError, ArithmeticError, ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
        raise DamagedProductError(
            f"{path}: is damaged or no product of thermofuse ({type(error).__name__}); run the campaign again"
        ) from error


def plain(value: Any) -> Any:
    """Return `value` in JSON's own types: models as objects, arrays as lists, NumPy scalars as numbers, times as ISO text, NaN as None."""
    if isinstance(value, BaseModel):
        value = value.model_dump(by_alias=True, exclude_unset=True)
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    if isinstance(value, np.datetime64):
        return None if np.isnat(value) else f"{np.datetime_as_string(value, unit='ms')}Z"
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return value.as_posix()
    return value


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file as hexadecimal text."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def digest(*parts: object) -> str:
    """Return one SHA-256 over anything that `plain` can express; equal input gives equal text on every machine."""
    text = json.dumps(plain(parts), sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _read_stamps(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the stamps of a results folder; of a stage without one, or with one that is damaged, nothing is known to be done."""
    return {
        stage: stamp
        for stage, stamp in read_json_object(folder / _STAMPS).items()
        if isinstance(stamp, dict) and {"key", "files", "note"} <= stamp.keys() and isinstance(stamp["files"], dict)
    }


class StageStamps:
    """Stages of a run that are done, with their input and their files; stored in the results folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = folder / _STAMPS
        self._stamps = _read_stamps(folder)

    def done(self, stage: str, key: str) -> bool:
        """Tell whether `stage` was finished from input `key` and its files are still as they were written."""
        stamp = self._stamps.get(stage)
        if stamp is None or stamp["key"] != key:
            return False
        return all(self._holds(name, sha) for name, sha in stamp["files"].items())

    def _holds(self, name: str, sha: str) -> bool:
        """Tell whether a file of a stage is as it was written."""
        path = place_within(self._folder, name)
        if path is None:
            raise OutputError(f"{self._path}: {name!r} leads out of the results folder; name another folder with --out")
        return path.is_file() and file_sha256(path) == sha

    def note(self, stage: str) -> Any:
        """Return what was noted when `stage` was recorded."""
        return self._stamps[stage]["note"]

    def forget(self, stage: str) -> None:
        """Remove the stamp of `stage`, where there is one, before its files are written again."""
        if self._stamps.pop(stage, None) is not None:
            write_json(self._path, self._stamps)

    def record(self, stage: str, key: str, files: Iterable[Path], note: object) -> None:
        """Stamp that `stage` is done from input `key` and wrote `files`; `note` is its share of results.json."""
        names = {path.relative_to(self._folder).as_posix(): file_sha256(path) for path in files}
        self._stamps[stage] = {"key": key, "files": names, "note": plain(note)}
        write_json(self._path, self._stamps)

    def renew(self, path: Path) -> None:
        """Stamp a file of finished stages as it is now, after it was written again from their products."""
        name = path.relative_to(self._folder).as_posix()
        holding = [stamp for stamp in self._stamps.values() if name in stamp["files"]]
        for stamp in holding:
            stamp["files"][name] = file_sha256(path)
        if holding:
            write_json(self._path, self._stamps)


def read_json(path: Path, *, constant: Callable[[str], object] | None = None) -> Any:
    """Return what a JSON file holds, or raise an OSError, or a ValueError that says why not; `constant` is json's `parse_constant`."""
    # The folder may be a stranger's: neither does a pipe hold the program nor a device fill its memory.
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError("it is a pipe, a socket or a device")
    with path.open("rb") as file:
        content = file.read(_MOST_JSON_BYTES + 1)
    if len(content) > _MOST_JSON_BYTES:
        raise ValueError(f"it is longer than {_MOST_JSON_BYTES // 1_000_000} MB")
    try:
        return json.loads(content.decode(), parse_constant=constant, parse_float=_measured)
    except RecursionError:
        raise ValueError("its brackets are nested too deep") from None


def _measured(text: str) -> float:
    """A number of a file; beyond any measured one its square overflows, and what is far below is nothing."""
    value = float(text)
    if abs(value) > _LARGEST:
        raise ValueError(f"{text} is no measured number")
    return value if abs(value) > 1.0 / _LARGEST**3 else 0.0


def read_json_object(path: Path) -> dict[str, Any]:
    """Return what a JSON file holds by name, empty where it is absent, damaged, or holds no such thing."""
    try:
        return dict(read_json(path))
    except (OSError, ValueError, TypeError):
        return {}


def require_own(folder: Path, names: Iterable[str]) -> None:
    """Refuse products that are not the files which the run of a folder wrote."""
    known = _products(folder)
    for name in names:
        path = folder / name
        if has_product(folder, name) and name in known and file_sha256(path) != known[name]["sha256"]:
            raise DamagedProductError(
                f"{path}: is not the file that this run wrote (its SHA-256 is not that of provenance.json); put that file back, or run the "
                "campaign again"
            )


def has_product(folder: Path, name: str) -> bool:
    """Return whether a run wrote a product; one that it wrote and that is not there any more is refused."""
    path = folder / name
    if not path.is_file() and name in _products(folder):
        raise DamagedProductError(f"{path} is missing; put the file back, or run the campaign again")
    return path.is_file()


def read_provenance(folder: Path) -> dict[str, Any]:
    """Return the provenance of a run, empty where its folder has none; one that cannot be read, and so checks nothing, is refused."""
    path, again = folder / "provenance.json", "run the campaign again, with --resume to keep what is finished"
    try:
        content = read_json(path)
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise DamagedProductError(
            f"{path}: cannot be read ({error.strerror or error}); allow reading it, or {again}"
        ) from None
    except ValueError as error:
        raise DamagedProductError(f"{path}: not JSON ({error}); {again}") from None
    tables = content.get("parameters", {}) if isinstance(content, dict) else None
    if (
        not isinstance(tables, dict)
        or not all(isinstance(table, dict) for table in tables.values())
        or not all(is_file_list(content.get(key, {})) for key in ("inputs", "products"))
    ):
        raise DamagedProductError(f"{path}: not the provenance of a run; {again}")
    return dict(content)


def _products(folder: Path) -> dict[str, Any]:
    """Return the files that the run of a folder wrote, by name, as its provenance lists them."""
    return dict(read_provenance(folder).get("products", {}))


def is_file_list(content: object) -> TypeGuard[dict[str, Any]]:
    """Return whether JSON is a list of files as a provenance holds it: by name, with ``bytes`` and ``sha256`` of each."""
    return isinstance(content, dict) and all(
        isinstance(one, dict) and "bytes" in one and isinstance(one.get("sha256"), str) for one in content.values()
    )


def finished_stages(folder: Path) -> list[str]:
    """Return the stages of a run that a results folder holds, in the order in which they were finished."""
    return list(_read_stamps(folder))


def noted_messages(folder: Path) -> list[dict[str, Any]]:
    """Return the notices of the finished stages of a run, also while it is under way."""
    notes = [stamp["note"] for stamp in _read_stamps(folder).values()]
    return [notice for note in notes if isinstance(note, dict) for notice in note.get("notices", [])]


#: What `annotate` writes for the whole file.
GLOBAL_ATTRIBUTES = ("Conventions", "title", "history", "provenance")


def annotate(product: Product, *, title: str, history: str, provenance: str) -> Product:
    """Return `product` with the global attributes of the CF conventions and a long name wherever none was given."""
    import xarray as xr

    described = product.copy()
    for node in described.subtree if isinstance(described, xr.DataTree) else (described,):
        for name, variable in node.variables.items():
            if "long_name" not in variable.attrs and "standard_name" not in variable.attrs:
                variable.attrs["long_name"] = name_in_words(str(name))
    described.attrs = {
        **product.attrs,
        "Conventions": "CF-1.11",
        "title": title,
        "history": history,
        "provenance": provenance,
    }
    return described


def name_in_words(name: str) -> str:
    """Return a variable's name as words: ``"local_rise_u"`` -> ``"standard uncertainty of local rise"``."""
    words = name.removesuffix("_u").replace("_", " ")
    return f"standard uncertainty of {words}" if name.endswith("_u") else words


# Contracts of Datasets: what an instrument makes, and what a product of a run holds when it is read again.

#: What every product of a kind holds, whatever the campaign: variable -> dims.
PRODUCTS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "thermograms": {
        **dict.fromkeys(("maximum", "minimum", "mean"), ("time", "region")),
        "thermogram": ("row", "column"),
    },
    "fields": {name: dims for name, (dims, *_) in FIELDS.items()},
    **{kind: {name: dims for name, (dims, *_) in DEVIATIONS.items()} for kind in ("deviations", "fusion")},
    "record": {"displacement": ("time", "channel"), "temperature": ("time", "sensor"), "predicted_u": ("channel",)},
    "sensors": {
        **dict.fromkeys(("temperature", "rise"), ("time", "sensor")),
        **dict.fromkeys(("x", "y", "is_faulty", "fault"), ("sensor",)),
    },
}


class ContractError(FusionError):
    """A Dataset that breaks its contract; the message lists every violation."""


def check(dataset: xr.Dataset, contract: Mapping[str, tuple[tuple[str, ...], str, str]], *, name: str) -> xr.Dataset:
    """Return `dataset` unchanged if it keeps `contract`."""
    faults = []
    for variable, (dims, units, kind) in contract.items():
        if variable not in dataset.variables:
            faults.append(f"{variable} is missing")
            continue
        array = dataset[variable]
        if array.dims != dims:
            faults.append(f"{variable} has dims {_tuple(array.dims)}, not {_tuple(dims)}")
        if units and array.attrs.get("units") != units:
            faults.append(f"{variable} is in {array.attrs.get('units', 'no unit')!r}, not {units!r}")
        if array.dtype.kind != kind:
            faults.append(f"{variable} is of type {array.dtype}, not of kind {kind!r}")
    if faults:
        raise ContractError(f"{name} breaks its contract: {'; '.join(faults)}")
    return dataset


def read_product(folder: Path, name: str) -> xr.Dataset:
    """Read a product of a run into memory; large fields are left in their file, see `open_dataset`."""
    path = folder / ("fusion.nc" if name == "record" else f"{name}.nc")
    require_own(folder, [path.name])
    read = {"fields": open_dataset, "deviations": read_grouped}.get(name, read_dataset)
    return require_kind(read(path), name, path)


def read_fusion(folder: Path) -> xr.DataTree:
    """Read the whole of ``fusion.nc`` into memory, as `read_product` reads its root."""
    path = folder / "fusion.nc"
    require_own(folder, [path.name])
    tree = read_tree(path)
    require_kind(tree.to_dataset(), "fusion", path)
    return tree


def require_kind(product: xr.Dataset, name: str, path: Path) -> xr.Dataset:
    """Return a product that was opened, if it holds what every product of its kind does."""
    expected = PRODUCTS[name].items()
    found = {variable: array.dims for variable, array in product.variables.items()}
    lacks = [f"{variable} {_tuple(dims)}" for variable, dims in expected if found.get(variable) != dims]
    lacks += ["places in mm"] if product.attrs.get("plan_unit") == "px" else []
    if lacks:
        product.close()
        raise DamagedProductError(
            f"{path}: is another kind of file: {', '.join(lacks[:3])}{' and more' if len(lacks) > 3 else ''} not in it; "
            "put the file of this run back, or run the campaign again"
        )
    return product


def _tuple(dims: tuple[object, ...]) -> str:
    return f"({', '.join(map(str, dims))})"


# Several results on the axes of one Dataset, each behind a prefix: the groups of deviations.nc, and the closed loop in
# fusion.nc.

#: Groups of deviations.nc.
GROUPS = ("estimate", "iso", "quoted", "conventional", "neighbours", "comparison", "chart")


def in_groups(dataset: xr.Dataset) -> xr.DataTree:
    """Return the readings with their results as a tree: ``estimate_profile`` as ``profile`` of the group ``estimate``."""
    import xarray as xr

    parts = {name: group(dataset, name) for name in GROUPS if has(dataset, name)}
    taken = [f"{name}_{key}" for name, part in parts.items() for key in part.data_vars]
    return xr.DataTree.from_dict({"/": dataset.drop_vars(taken), **parts})


def read_grouped(path: Path) -> xr.Dataset:
    """Read a tree written by `in_groups` as the Dataset that it was."""
    tree = read_tree(path)
    return joined(tree.to_dataset(), **{name: node.to_dataset() for name, node in tree.children.items()})


def joined(base: xr.Dataset, **parts: xr.Dataset) -> xr.Dataset:
    """Return `base` with the data variables of several results, ``profile`` of ``estimate`` as ``estimate_profile``."""
    renamed = {f"{name}_{key}": array for name, part in parts.items() for key, array in part.data_vars.items()}
    return base.assign(renamed)


def group(dataset: xr.Dataset, name: str) -> xr.Dataset:
    """Return the data variables of one result under their own names, with the coordinates that they are on."""
    prefix = f"{name}_"
    chosen = [variable for variable in dataset.data_vars if str(variable).startswith(prefix)]
    return dataset[chosen].rename({variable: str(variable).removeprefix(prefix) for variable in chosen})


def has(dataset: xr.Dataset, name: str) -> bool:
    """Return whether a result is in a Dataset."""
    return any(str(variable).startswith(f"{name}_") for variable in dataset.data_vars)


def by_approach(variable: xr.DataArray, **places: np.ndarray) -> np.ndarray:
    """Return the values at places of one dimension, by place and direction of approach, for a table that goes through them."""
    return variable.sel({**places, "direction": list(DIRECTIONS)}).transpose(*places, "direction").values
