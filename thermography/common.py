"""What the whole package shares: its error, the contract of its products, and a robust scatter; light to import."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

Array: TypeAlias = "NDArray[Any]"

_log = logging.getLogger(__name__)

ZERO_CELSIUS_K = 273.15
#: Standard deviation of a normal distribution over its median absolute deviation, to five digits. The exact 1 / 0.67449 (as SciPy's
#: ``median_abs_deviation(..., scale="normal")`` has it) differs by 1.5e-6 and would change the last digits of stored results.
MAD_TO_SIGMA = 1.4826


def usable_processors() -> int:
    """Return how many processors this process may use: where it is bound to some, these alone."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


#: Tells this process, and those that it starts, that it was said.
_SAID = "THERMOFUSE_COMPILES_IN_MEMORY"


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a function that numba compiles: once where there is a folder that it can write to, else in every process."""
    import numba

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError as error:
            if "no locator" not in str(error):  # for lack of a folder
                raise
            if not os.environ.get(_SAID):
                os.environ[_SAID] = "1"
                _log.warning(
                    "no folder can be written in which compiled functions are kept, so that every command compiles them again (up to half "
                    "a minute); let NUMBA_CACHE_DIR name one"
                )
            return numba.njit(**options)(function)

    return compiled


#: Median absolute deviation of a standard normal distribution.
_NORMAL_MEDIAN = 0.6744897501960817


def scatter_by_median(values: ArrayLike, *, centre: float | None = None) -> float:
    """Standard deviation of normal values by their median absolute deviation, which up to half of them cannot spoil."""
    import numpy as np

    known = np.asarray(values, float)
    known = known[~np.isnan(known)]
    if known.size == 0:
        return float("nan")
    about = np.median(known) if centre is None else centre
    return float(np.median(np.abs(known - about))) / _NORMAL_MEDIAN


#: Contract of the products, on which other packages rely: name of a variable -> (dims, units, kind), kind being a NumPy dtype kind
#: (``f``, ``i``, ``u``, ``M``).
Contract = dict[str, tuple[tuple[str, ...], str, str]]

#: Fields on the table plan; ``x`` and ``y`` are plan coordinates in mm, ``cycle`` counts from 1.
FIELDS: Contract = {
    "temperature": (("cycle", "y", "x"), "degC", "f"),
    "temperature_u": (("cycle", "y", "x"), "K", "f"),
    "temperature_noise_u": (("cycle", "y", "x"), "K", "f"),
    "temperature_rise": (("cycle", "y", "x"), "K", "f"),
    "temperature_rise_u": (("cycle", "y", "x"), "K", "f"),
    "temperature_rise_noise_u": (("cycle", "y", "x"), "K", "f"),
    "rise_scale_u": (("y", "x"), "1", "f"),
    "temperature_spread": (("cycle", "y", "x"), "K", "f"),
    "count": (("cycle", "y", "x"), "1", "i"),
    "cycle_time": (("cycle",), "", "M"),
    "frame_temperature": (("time", "y", "x"), "degC", "f"),
}


class ThermographyError(ValueError):
    """Input that cannot be used; the message names the place, the value and the remedy.

    Every error that this package raises about its input is a subclass, so that a caller recognises all of them by class.
    """
