"""Several results on the axes of one Dataset, each behind a prefix: the parts of deviations.nc, and the closed loop in fusion.nc.

In deviations.nc these are conventional, neighbours, comparison, chart, iso, settled and drift; in the root of fusion.nc it is the loop.
Most of their variables share the coordinates of the readings, so that plain arithmetic between them works. The variables are prefixed,
dimensions and coordinates are not: they stay on the Dataset under their own names. The correlation, which has axes of its own, is a group
of fusion.nc without a prefix; see `fusion.products.store.write_dataset`.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from interferometry.deviations import DIRECTIONS


def joined(base: xr.Dataset, **parts: xr.Dataset) -> xr.Dataset:
    """Return a Dataset with the variables of several results under prefixed names.

    Parameters
    ----------
    base : Dataset
        Keeps its own names.
    **parts : Dataset
        Results by name, on the coordinates of `base` as far as they share dims; a data variable ``v`` becomes ``<name>_v``, a coordinate
        keeps its name.

    Returns
    -------
    Dataset
        With the attributes of `base`.

    Examples
    --------
    >>> import xarray as xr
    >>> readings = xr.Dataset({"deviation": ("target", [0.1, 0.2])})
    >>> list(joined(readings, drift=xr.Dataset({"profile": ("target", [1.0, 2.0])})))
    ['deviation', 'drift_profile']
    """
    for name, part in parts.items():
        base = base.assign({f"{name}_{variable}": array for variable, array in part.data_vars.items()})
    return base


def group(dataset: xr.Dataset, name: str) -> xr.Dataset:
    """Return the data variables of one result under their own names, with the coordinates that they are on.

    Parameters
    ----------
    dataset : Dataset
        As from `joined`.
    name : str
        Name of the result.

    Returns
    -------
    Dataset
        Without variables where the result is not in it.
    """
    prefix = f"{name}_"
    chosen = [variable for variable in dataset.data_vars if str(variable).startswith(prefix)]
    return dataset[chosen].rename({variable: str(variable).removeprefix(prefix) for variable in chosen})


def has(dataset: xr.Dataset, name: str) -> bool:
    """Return whether a result is in a Dataset.

    Parameters
    ----------
    dataset : Dataset
        As from `joined`.
    name : str
        Name of the result.

    Returns
    -------
    bool
    """
    return any(str(variable).startswith(f"{name}_") for variable in dataset.data_vars)


def by_approach(variable: xr.DataArray, **places: np.ndarray) -> np.ndarray:
    """Return the values at places of one dimension, by place and direction of approach, for a table that goes through them.

    Parameters
    ----------
    variable : DataArray
        Over that dimension and ``direction``, in any order and unit.
    **places : ndarray
        Labels along the dimension, by its name.

    Returns
    -------
    (place, 2) ndarray
        The positive approach first.
    """
    return variable.sel({**places, "direction": list(DIRECTIONS)}).transpose(*places, "direction").values
