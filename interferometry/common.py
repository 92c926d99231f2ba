"""What the whole package shares: its error, and the contract of the Datasets that readers return and evaluations take."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, ParamSpec, TypeAlias, TypeVar, cast

from threadpoolctl import threadpool_limits

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

#: Name of a variable -> (dims, units, kind), kind being a NumPy dtype kind.
Contract = dict[str, tuple[tuple[str, ...], str, str]]

#: Deviations per cycle, direction ("positive", "negative") and target; missing readings are NaN with time NaT.
DEVIATIONS: Contract = {
    "deviation": (("cycle", "direction", "target"), "um", "f"),
    "time": (("cycle", "direction", "target"), "", "M"),
    "position": (("target",), "mm", "f"),
    "quality_flag": (("cycle", "direction", "target"), "1", "u"),
}

#: Logged conditions of air and material.
ENVIRONMENT: Contract = {
    "time": (("time",), "", "M"),
    "air_temperature": (("time",), "degC", "f"),
    "air_pressure": (("time",), "hPa", "f"),
    "relative_humidity": (("time",), "percent", "f"),
    "material_temperature": (("time",), "degC", "f"),
}

#: What the search for anomalous positions takes from the joint estimate of profile and drift.
ESTIMATE: Contract = {
    "standardised": (("cycle", "direction", "target"), "1", "f"),
    "scatter": (("direction", "target"), "um", "f"),
    "scatter_freedom": (("direction", "target"), "1", "f"),
    "scatter_position": (("target",), "um", "f"),
    "sigma": ((), "um", "f"),
    "resolution": ((), "um", "f"),
}

#: Name of a contracted argument -> its contract, and what returns such a Dataset.
_ARGUMENTS = {
    "deviations": (DEVIATIONS, "read_deviations or build_deviations"),
    "environment": (ENVIRONMENT, "read_environment"),
    "estimated": (ESTIMATE, "estimate_drift"),
}


def check_dataset(dataset: xr.Dataset, argument: str) -> None:
    """Refuse what lacks a variable of the contract of an argument, or holds it over other dims."""
    contract, source = _ARGUMENTS[argument]
    remedy = f"give what {source} returns"
    import xarray as xr

    if not isinstance(dataset, xr.Dataset):
        raise InterferometryError(f"{argument} is of type {type(dataset).__name__}, not a Dataset; {remedy}")
    for name, (dims, *_) in contract.items():
        if name == "quality_flag":
            continue
        expected = f"{name!r} ({', '.join(dims)})"
        if name not in dataset.variables:
            raise InterferometryError(f"{argument} has no variable {expected}; {remedy}")
        if dataset[name].dims != dims:
            raise InterferometryError(
                f"{argument} has {name!r} over ({', '.join(map(str, dataset[name].dims))}) instead of {expected}; {remedy}"
            )
