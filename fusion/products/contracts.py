"""Check of a Dataset against the contract of the instrument that made it."""

from __future__ import annotations

from collections.abc import Mapping

import xarray as xr

from fusion.errors import FusionError


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


def _tuple(dims: tuple[object, ...]) -> str:
    return f"({', '.join(map(str, dims))})"
