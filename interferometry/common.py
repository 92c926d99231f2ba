"""What the whole package shares: its error, and the contract of the Datasets that readers return and evaluations take."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import fields
from numbers import Real
from typing import TYPE_CHECKING, Any, ParamSpec, TypeAlias, TypeVar, cast

from threadpoolctl import threadpool_limits

from thermofuse.resources import variables
from thermofuse.units import conform, find_unit

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    from numpy.typing import NDArray

Array: TypeAlias = "NDArray[np.float64]"


class InterferometryError(ValueError):
    """Input that cannot be used; the message names the place, the value and the remedy.

    Every error that this package raises about its input is of this class or a subclass.
    """


_P = ParamSpec("_P")
_T = TypeVar("_T")


def one_thread(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Decorate a function that keeps linear algebra to one thread: several are slower on small matrices, and give other last digits."""
    return cast(Callable[_P, _T], threadpool_limits.wrap(limits=1, user_api="blas")(function))


DIRECTIONS = ("positive", "negative")

#: Contract and attributes of deviations and of logged conditions, and what the search for anomalies takes from the joint estimate.
DEVIATIONS, DEVIATION_ATTRIBUTES = variables("deviations")
ENVIRONMENT, ENVIRONMENT_ATTRIBUTES = variables("environment")
ESTIMATE = variables("estimate")[0]


def check_uncertainties(
    parameters: Any, *, signed: Collection[str] = (), error: type[InterferometryError] = InterferometryError
) -> None:
    """Refuse fields of a dataclass that are neither None nor finite numbers, or negative without being `signed`."""
    for field in fields(parameters):
        value = getattr(parameters, field.name)
        if value is None:
            continue
        if not isinstance(value, Real) or not math.isfinite(value) or (value < 0 and field.name not in signed):
            raise error(f"{field.name}={value!r}: give a finite number{'' if field.name in signed else ', 0 or more'}")


#: Name of a contracted argument -> contract, attributes with the units, and what returns such a Dataset.
_ARGUMENTS = {
    "deviations": (DEVIATIONS, DEVIATION_ATTRIBUTES, "read_deviations or build_deviations"),
    "environment": (ENVIRONMENT, ENVIRONMENT_ATTRIBUTES, "read_environment"),
    "estimated": (*variables("estimate"), "estimate_drift"),
}
#: Units of the readings of a rotary axis.
_ROTARY = {"deviation": "arcsec", "position": "deg"}


def check_dataset(dataset: xr.Dataset, argument: str, *, rotary: bool = False) -> xr.Dataset:
    """Return an argument in the units of its contract, of a rotary axis (where it is accepted) in those of angles; refuse what lacks a
    variable, or holds it over other dims or in a unit that cannot be converted.
    """
    contract, described, source = _ARGUMENTS[argument]
    if rotary and "deviation" in getattr(dataset, "variables", ()):
        unit = find_unit(str(dataset["deviation"].attrs.get("units")))
        if unit is not None and unit.kind == "angle":
            described = {name: {"units": unit} for name, unit in _ROTARY.items()}
    needs = {name: dims for name, (dims, *_) in contract.items() if name != "quality_flag"}
    return conform(dataset, needs, described, name=argument, source=source, error=InterferometryError)
