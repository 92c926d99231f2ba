"""The thermal state that a profile belongs to: when it was measured, and how warm material and air were."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from fusion.products.contracts import read_product
from fusion.report.wording import moment

#: Variables of fusion.nc that say how warm it was, and their names.
_TEMPERATURES = {"material_temperature": "material", "air_temperature": "air"}


@dataclass(frozen=True)
class ThermalState:
    """When and how warm.

    Attributes
    ----------
    first, last : datetime64
        Time of the first and the last reading, UTC; NaT where the file has no times.
    cycles : tuple of int
        Number of the first and the last cycle.
    temperatures_degC : dict of str to (mean, lowest, highest)
        Of material and air at the readings, the mean over cycles of equal weight, as for the profile; what was not logged is absent.
    """

    first: np.datetime64
    last: np.datetime64
    cycles: tuple[int, int]
    temperatures_degC: dict[str, tuple[float, float, float]]

    def sentence(self) -> str:
        """Return the state in words, in ASCII."""
        logged = [
            f"{name} {mean:.2f} degC ({low:.2f} to {high:.2f})"
            for name, (mean, low, high) in self.temperatures_degC.items()
        ]
        missing = [name for name in _TEMPERATURES.values() if name not in self.temperatures_degC]
        unknown = [f"{name} not recorded" for name in missing]
        return f"mean of cycles {self.cycles[0]} to {self.cycles[1]}: {', '.join([*logged, *unknown])}"

    def period(self) -> str:
        """Return when it was measured."""
        return "not recorded" if np.isnat(self.first) else f"{moment(self.first)} to {moment(self.last)}"


def read_thermal_state(folder: Path, deviations: xr.Dataset) -> ThermalState:
    """Return the thermal state of a run.

    Parameters
    ----------
    folder : Path
        Results folder; temperatures are in ``fusion.nc``.
    deviations : Dataset
        Product ``deviations.nc``.
    """
    times = deviations["time"].values
    timed = times[~np.isnat(times)]
    cycles = deviations["cycle"].values
    found = {}
    if (folder / "fusion.nc").is_file():
        fused = read_product(folder, "fusion")
        for variable, name in _TEMPERATURES.items():
            if variable in fused and bool(fused[variable].notnull().any()):
                values = fused[variable]
                mean = float(values.mean(["direction", "target"]).mean())
                found[name] = (mean, float(values.min()), float(values.max()))
    unknown = np.datetime64("NaT")
    return ThermalState(
        timed.min() if timed.size else unknown,
        timed.max() if timed.size else unknown,
        (int(cycles.min()), int(cycles.max())),
        found,
    )
