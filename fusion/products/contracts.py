"""Contracts of Datasets: what an instrument makes, and what a product of a run holds when it is read again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import xarray as xr

from fusion.errors import FusionError
from fusion.products.store import DamagedProductError, open_dataset, read_dataset, read_tree, require_own
from interferometry.contract import DEVIATIONS
from thermography.contract import FIELDS

_READINGS = {name: dims for name, (dims, *_) in DEVIATIONS.items()}
#: What every product of a kind holds, whatever the campaign: variable -> dims.
PRODUCTS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "fields": {name: dims for name, (dims, *_) in FIELDS.items()},
    "deviations": _READINGS,
    "fusion": _READINGS,
    "record": {"displacement": ("time", "channel"), "temperature": ("time", "sensor"), "predicted_u": ("channel",)},
    "sensors": {
        **dict.fromkeys(("temperature", "rise"), ("time", "sensor")),
        **dict.fromkeys(("x", "y", "is_faulty", "fault"), ("sensor",)),
    },
}


class ContractError(FusionError):
    """A Dataset that breaks its contract; the message lists every violation."""


def check(dataset: xr.Dataset, contract: Mapping[str, tuple[tuple[str, ...], str, str]], *, name: str) -> xr.Dataset:
    """Return `dataset` unchanged if it keeps `contract`.

    Parameters
    ----------
    dataset : Dataset
        Result of an instrument package.
    contract : mapping
        ``variable -> (dims, units, kind)``; kind is a NumPy dtype kind, an empty unit is not checked.
    name : str
        Name of the Dataset in the message.

    Raises
    ------
    ContractError
        With all faults in one message: missing variables, dims in another order, other units, other kinds of number.
    """
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
    """Read a product of a run into memory; large fields are left in their file, see `open_dataset`.

    Parameters
    ----------
    folder : Path
        Results folder.
    name : {"fields", "deviations", "fusion", "record", "sensors"}
        Kind of product; of ``fusion.nc`` the root, which ``record`` reads as that of a record.

    Returns
    -------
    Dataset

    Raises
    ------
    DamagedProductError
        If the file is not what the run wrote, see `require_own`, is no NetCDF, or holds something else.
    FileNotFoundError
        If there is none.
    """
    path = folder / ("fusion.nc" if name == "record" else f"{name}.nc")
    require_own(folder, [path.name])
    read = open_dataset if name == "fields" else read_dataset
    return require_kind(read(path), name, path)


def read_fusion(folder: Path) -> xr.DataTree:
    """Read the whole of ``fusion.nc`` into memory, as `read_product` reads its root.

    Parameters
    ----------
    folder : Path
        Results folder.
    """
    path = folder / "fusion.nc"
    require_own(folder, [path.name])
    tree = read_tree(path)
    require_kind(tree.to_dataset(), "fusion", path)
    return tree


def require_kind(product: xr.Dataset, name: str, path: Path) -> xr.Dataset:
    """Return a product that was opened, if it holds what every product of its kind does.

    Parameters
    ----------
    product : Dataset
        Content of the file.
    name : str
        Kind of product, a key of `PRODUCTS`.
    path : Path
        The file, for the message.

    Raises
    ------
    DamagedProductError
        With the variables that are missing, or lie over other dims. What is refused is closed.
    """
    lacks = [
        f"{variable} {_tuple(dims)}"
        for variable, dims in PRODUCTS[name].items()
        if variable not in product.variables or product[variable].dims != dims
    ]
    if lacks:
        product.close()
        raise DamagedProductError(
            f"{path}: is another kind of file: {', '.join(lacks[:3])}{' and more' if len(lacks) > 3 else ''} not in it; "
            "put the file of this run back, or run the campaign again"
        )
    return product


def _tuple(dims: tuple[object, ...]) -> str:
    return f"({', '.join(map(str, dims))})"
