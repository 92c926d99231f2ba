"""Several results on the axes of one Dataset, each behind a prefix: the parts of deviations.nc, and the closed loop in fusion.nc.

They share the coordinates of the readings, so that plain arithmetic between them works. Results on axes of their own (the correlation) are
groups of the NetCDF file instead; see `fusion.products.store.write_dataset`.
"""

from __future__ import annotations

import xarray as xr


def joined(base: xr.Dataset, **parts: xr.Dataset) -> xr.Dataset:
    """Return a Dataset with the variables of several results under prefixed names.

    Parameters
    ----------
    base : Dataset
        Keeps its own names.
    **parts : Dataset
        Results by name, on the coordinates of `base` as far as they share dims; a variable ``v`` becomes ``<name>_v``.

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
    """Return the variables of one result under their own names.

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
