"""What the whole package shares: its error, and the contract of the Datasets that readers return and evaluations take."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, ParamSpec, TypeAlias, TypeVar, cast

from threadpoolctl import threadpool_limits

from thermofuse.resources import variables

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
