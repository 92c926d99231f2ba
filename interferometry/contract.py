"""Contract of the Datasets of deviations and of logged conditions, which every reader returns and every evaluation takes.

A contract maps the name of a variable to ``(dims, units, kind)``, kind being a NumPy dtype kind (``f``, ``i``, ``u``, ``M``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from interferometry.errors import InterferometryError

if TYPE_CHECKING:
    import xarray as xr

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
}

#: Name of a contracted argument -> its contract, and what returns such a Dataset.
_ARGUMENTS = {
    "deviations": (DEVIATIONS, "read_deviations or build_deviations"),
    "environment": (ENVIRONMENT, "read_environment"),
    "estimated": (ESTIMATE, "estimate_drift"),
}


def check_dataset(dataset: xr.Dataset, argument: str) -> None:
    """Refuse what lacks a variable of the contract of an argument, or holds it over other dims.

    Units and kinds are not compared: Datasets computed from others lose attributes and change precision.

    Parameters
    ----------
    dataset : xarray.Dataset
        The value of the argument.
    argument : {"deviations", "environment", "estimated"}
        Its name, which selects the contract; ``quality_flag`` is not needed.

    Raises
    ------
    InterferometryError
        Names the argument, the variable and the function that returns such a Dataset.
    """
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
