"""Several results on the axes of one Dataset, each behind a prefix: the parts of deviations.nc, and the closed loop in fusion.nc."""

from __future__ import annotations

import xarray as xr


def joined(base: xr.Dataset, **parts: xr.Dataset) -> xr.Dataset:
    """Return `base` with the variables of each part added as ``<part>_<variable>``."""
    for name, part in parts.items():
        base = base.assign({f"{name}_{variable}": array for variable, array in part.data_vars.items()})
    return base


def group(dataset: xr.Dataset, name: str) -> xr.Dataset:
    """Return the variables of one part under their own names; empty where the part is not there."""
    prefix = f"{name}_"
    chosen = [variable for variable in dataset.data_vars if str(variable).startswith(prefix)]
    return dataset[chosen].rename({variable: str(variable).removeprefix(prefix) for variable in chosen})


def has(dataset: xr.Dataset, name: str) -> bool:
    """Tell whether a part is there."""
    return any(str(variable).startswith(f"{name}_") for variable in dataset.data_vars)
