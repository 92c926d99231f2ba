"""What the screen *Results* reads of a results folder: small tables at once, the fields of the camera one cycle or one place at a time."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import param
import xarray as xr

from fusion.app.parts import schedule_update
from fusion.report.charts.plan import LAYERS, Layer, scale_of
from fusion.results.results import Results, read_results
from fusion.results.store import group, has, open_in_file, read_product, require_kind, require_own

#: Cycles from which the one colour scale of all cycles is taken; of a longer test evenly spaced ones.
_SCALE_CYCLES = 60
#: A fields.nc of up to so many bytes is compared with the hash of its run; reading a larger one takes longer than a screen may wait.
_HASHED_BYTES = 100_000_000


class Products:
    """The products of a finished run by its results folder, as a screen shows them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.results: Results = read_results(folder)
        self._scales: dict[str, tuple[dict[str, Any], bool]] = {}

    def __del__(self) -> None:
        """Close fields.nc where it was opened."""
        if "fields" in self.__dict__ and self.fields is not None:
            self.fields.close()

    @cached_property
    def fields(self) -> xr.Dataset | None:
        """fields.nc, opened and not read; None without a camera."""
        path = self.folder / "fields.nc"
        if not path.is_file():
            return None
        if path.stat().st_size <= _HASHED_BYTES:
            require_own(self.folder, [path.name])
        return require_kind(open_in_file(path), "fields", path)

    @cached_property
    def deviations(self) -> xr.Dataset | None:
        """Content of deviations.nc; None without a laser."""
        return read_product(self.folder, "deviations") if (self.folder / "deviations.nc").is_file() else None

    @cached_property
    def drift(self) -> xr.Dataset | None:
        """The joint estimate of profile and drift; None where the readings have no times, or there are none."""
        read = self.deviations
        return group(read, "estimate") if read is not None and has(read, "estimate") else None

    @property
    def layers(self) -> list[Layer]:
        """The quantities of the map."""
        return [] if self.fields is None else [layer for layer in LAYERS if layer.variable in self.fields]

    @property
    def cycles(self) -> np.ndarray:
        """Numbers of the cycles, of the camera or else of the laser."""
        for product in (self.fields, self.deviations):
            if product is not None:
                return np.asarray(product["cycle"].values, int)
        return np.array([], int)

    @property
    def camera(self) -> xr.Dataset:
        """fields.nc of a run that has a camera."""
        assert self.fields is not None
        return self.fields

    def map_of(self, layer: Layer, cycle: int) -> np.ndarray:
        """Return one quantity in one cycle, (y, x)."""
        return np.asarray(self.camera[layer.variable].sel(cycle=cycle).values)

    def scale(self, layer: Layer) -> tuple[dict[str, Any], bool]:
        """Return the one colour scale of a quantity, and whether all cycles entered it; the maps are read one at a time."""
        if layer.words not in self._scales:
            count = self.camera.sizes["cycle"]
            chosen = np.unique(np.linspace(0, count - 1, min(count, _SCALE_CYCLES)).astype(int))
            maps = [self.camera[layer.variable].isel(cycle=int(at)).values for at in chosen]
            self._scales[layer.words] = scale_of(np.stack(maps), layer), chosen.size == count
        return self._scales[layer.words]

    def place_over_time(self, layer: Layer, x_mm: float, y_mm: float, size_mm: float) -> tuple[np.ndarray, int]:
        """Return the mean of one quantity over a square of the plan in every cycle, (cycle,), and how many cells it has."""
        columns, rows = (_within(self.camera[axis].values, at, size_mm) for axis, at in (("x", x_mm), ("y", y_mm)))
        chosen = self.camera[layer.variable].isel(x=columns, y=rows)
        return chosen.mean(["x", "y"]).values, chosen[0].size

    @cached_property
    def field_hours(self) -> np.ndarray:
        """Mean time of the frames of every cycle, h since the first reading of the laser, or since the first cycle."""
        times = self.camera["cycle_time"].values
        read = times[:1] if self.deviations is None else self.deviations["time"].values
        known = read[~np.isnat(read)]
        return np.asarray((times - (known.min() if known.size else times[0])) / np.timedelta64(1, "h"), float)


def _within(cells: np.ndarray, at: float, size: float) -> slice:
    """Return the cells whose middle lies within half a size of a place, at least the nearest one."""
    inside = np.flatnonzero(np.abs(cells - at) <= size / 2)
    if inside.size == 0:
        inside = np.array([int(np.argmin(np.abs(cells - at)))])
    return slice(int(inside[0]), int(inside[-1]) + 1)


# What is chosen on the screen *Results*: a cycle and places on the plan.


class Place(NamedTuple):
    """Middle and side of a square of the plan whose mean temperature is shown over time, mm; side 0 is one cell."""

    x_mm: float
    y_mm: float
    size_mm: float

    @property
    def words(self) -> str:
        """The place as a legend names it."""
        size = f", {self.size_mm:g} mm square" if self.size_mm else ""
        return f"x {self.x_mm:.0f} mm, y {self.y_mm:.0f} mm{size}"


class Selection(param.Parameterized):
    """The choice of one page; places in the order in which they were added."""

    cycle: int = param.Integer()
    places: list[Place] = param.List(item_type=Place)

    def watch(self, update: Callable[[], None], name: str) -> param.parameterized.Watcher:
        """Let a chart follow one of the choices."""
        return self.param.watch(lambda event: schedule_update(update), name)

    def add(self, place: Place) -> None:
        """Add a place, once."""
        if place not in self.places:
            self.places = [*self.places, place]
