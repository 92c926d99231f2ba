"""Units as headings and Datasets state them, and Datasets that cross a border in those of their contract."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from thermofuse.resources import vocabulary, with_degree_sign

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Unit:
    """A unit: its kind of quantity ("length", ...); value * factor + offset is in mm, deg, degC, hPa, percent, s, ppm/K, mm/min or px."""

    name: str
    kind: str
    factor: float
    offset: float


#: Units of positions and deviations, as they are stated of a table that names none.
UnitName = Literal["um", "mm", "m", "nm", "in", "mil", "uin", "deg", "arcmin", "arcsec"]
_VOCABULARY = vocabulary("units")
#: Units by their names.
UNITS = {
    one["name"]: Unit(one["name"], one["kind"], one.get("factor", 1.0), one.get("offset", 0.0))
    for one in _VOCABULARY["units"]
}
#: Other units, and what loggers write in a row of units for their own columns.
OF_LOGGERS = frozenset(_VOCABULARY["of_loggers"])
_WRITTEN = UNITS | {text: UNITS[one["name"]] for one in _VOCABULARY["units"] for text in one.get("written", ())}
#: In any case; a single letter is another unit in the other one.
_WORDS = {
    text.casefold(): UNITS[one["name"]]
    for one in _VOCABULARY["units"]
    for text in (one["name"], *one.get("words", ()))
    if len(text) > 1 or not text.isascii() or not text.isalpha()
}
#: A power of ten before a unit, whose share the numbers count: "0.1 um", "1/10 um", "1e-3 mm", "10^-3 mm".
SHARE = re.compile(r"(?:1/1(?P<over>0+)|0?[.,](?P<zeros>0*)1|(?:1e|10\^?)-(?P<power>\d))\s*(?=[^\s\d])", re.IGNORECASE)


def find_unit(text: str) -> Unit | None:
    """Return the unit that a text names, or the share of one; None where it is none."""
    # Two signs are used for micro: the Greek letter and the micro sign.
    written = with_degree_sign(text).replace("μ", "µ")
    if written[:1] in "[(" and written[-1:] in "])":
        written = written[1:-1].strip()
    if (share := SHARE.match(written)) and (whole := find_unit(written[share.end() :])):
        tens = int(share["power"] or len(share["over"] or "") or len(share["zeros"] or "") + 1)
        part = Unit("", whole.kind, whole.factor / 10.0**tens, whole.offset)
        alike = (unit for unit in UNITS.values() if replace(unit, name="") == part)
        return next(alike, replace(part, name=f"{share[0].strip()} {whole.name}"))
    if written in OF_LOGGERS and written not in _WRITTEN:
        return None
    # Hours are shortened to hrs. and Std.
    return _WRITTEN.get(written) or _WORDS.get(written.casefold().removesuffix("."))


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
        old, new = find_unit(str(given)), find_unit(wanted)
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
