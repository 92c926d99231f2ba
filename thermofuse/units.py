"""Units as headings and Datasets state them, and Datasets that cross a border in those of their contract."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from thermofuse.resources import vocabulary, with_degree_sign

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Unit:
    """A unit: its kind of quantity ("length", ...); value * factor + offset is in mm, deg, degC, hPa or percent."""

    kind: str
    factor: float
    offset: float


#: Words for shares of a unit of length, as in "0.1 um", and their factors.
SHARES = [(word, float(share)) for share, words in vocabulary("headings")["shares"].items() for word in words]
#: Unit as it is written, in lower case -> its meaning.
UNITS = {
    word: Unit(unit["kind"], unit["factor"], unit["offset"])
    for unit in vocabulary("headings")["units"]
    for word in unit["words"]
}
UNITS |= {
    f"{share}{gap}{word}": Unit(unit.kind, factor * unit.factor, 0.0)
    for word, unit in UNITS.items()
    for share, factor in SHARES
    for gap in ("", " ")
    if unit.kind == "length"
}


def find_unit(text: str) -> str | None:
    """Return the key of a unit as it is written, None where it is none."""
    # Two signs are used for micro: the Greek letter and the micro sign.
    cleaned = with_degree_sign(text).casefold().replace("μ", "µ").replace("’’", "''")
    return cleaned if cleaned in UNITS else None


def conform(
    dataset: xr.Dataset,
    needs: Mapping[str, tuple[str, ...]],
    described: Mapping[str, Mapping[str, str]],
    *,
    name: str,
    source: str,
    error: type[Exception],
) -> xr.Dataset:
    """Return a Dataset with variables over the dims that are needed, in the units in which they are described; others are converted."""
    import xarray as xr

    remedy = f"give what {source} returns"
    if not isinstance(dataset, xr.Dataset):
        raise error(f"{name} is of type {type(dataset).__name__}, not a Dataset; {remedy}")
    changed: dict[str, xr.Variable] = {}
    for variable, dims in needs.items():
        expected = f"{variable!r} ({', '.join(dims)})"
        if variable not in dataset.variables:
            raise error(f"{name} has no variable {expected}; {remedy}")
        found = dataset[variable].dims
        if {*found} != {*dims}:
            raise error(f"{name} has {variable!r} over ({', '.join(map(str, found))}) instead of {expected}; {remedy}")
        if found != dims:
            changed[variable] = dataset[variable].variable.transpose(*dims)
    for variable in sorted({*map(str, dataset.variables)} & described.keys()):
        wanted, given = (one.get("units") for one in (described[variable], dataset[variable].attrs))
        if not wanted or given is None or given == wanted:
            continue
        old, new = (UNITS.get(find_unit(str(unit)) or "") for unit in (given, wanted))
        if old is None or new is None or old.kind != new.kind:
            raise error(
                f"{name}[{variable!r}] is in {given!r}, which cannot be converted to {wanted!r}; give it in {wanted!r}, or correct its "
                "attrs['units']"
            )
        is_difference = described[variable].get("units_metadata", "").endswith("difference")
        offset = 0.0 if is_difference else old.offset - new.offset
        array = changed.get(variable, dataset[variable].variable)
        changed[variable] = array.copy(data=(array.values * old.factor + offset) / new.factor)
        changed[variable].attrs = {**array.attrs, "units": wanted}
    coords = {variable: changed.pop(variable) for variable in [*changed] if variable in dataset.coords}
    return dataset.assign(changed).assign_coords(coords)
