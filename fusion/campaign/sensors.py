"""Contact sensors of a campaign: their temperatures over time, and their places on the plan."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from fusion._typing import Array
from fusion.alignment.sensor_health import SensorFault, examine_sensors
from fusion.campaign.config import Campaign
from fusion.campaign.logged_tables import TableError, read_drivers
from fusion.campaign.quantities import QuantityError, conversion
from fusion.campaign.time_zones import bring_to_utc
from interferometry.io.delimited import BadReading, read_table


@dataclass(frozen=True, eq=False)
class ContactSensors:
    """Temperatures of contact sensors on the table.

    Attributes
    ----------
    file : str
        File of the temperatures, for messages.
    logged : (time, sensor) DataArray, degC
        As logged, the faulty sensors among them; times in UTC, the sensors by name; NaN where a sensor gave nothing.
    logged_x_mm, logged_y_mm : (sensors,) ndarray, mm
        Places on the plan.
    u_K : float, K
        Standard uncertainty of one sensor.
    faults : tuple of SensorFault
        What is clearly wrong with a sensor (docs/method/sensor-health.md), which is then left out of everything that is calculated.
    """

    file: str
    logged: xr.DataArray
    logged_x_mm: Array
    logged_y_mm: Array
    u_K: float
    faults: tuple[SensorFault, ...] = ()

    @property
    def sound(self) -> list[int]:
        """Places among the logged sensors of those that are used."""
        faulty = {fault.sensor for fault in self.faults}
        return [k for k in range(self.logged.sizes["sensor"]) if k not in faulty]

    @property
    def temperature(self) -> xr.DataArray:
        """Temperatures of the sound sensors at the times at which all of them gave one, (time, sensor) degC."""
        return self.logged.isel(sensor=self.sound).dropna("time")

    @property
    def x_mm(self) -> Array:
        """Places of the sound sensors along x, (sensors,) mm."""
        return self.logged_x_mm[self.sound]

    @property
    def y_mm(self) -> Array:
        """Places of the sound sensors along y, (sensors,) mm."""
        return self.logged_y_mm[self.sound]

    @property
    def names(self) -> list[str]:
        """Names of the sound sensors."""
        return [str(name) for name in self.logged["sensor"].values[self.sound]]


def read_sensors(campaign: Campaign) -> ContactSensors | None:
    """Read the contact sensors of a campaign.

    Parameters
    ----------
    campaign : Campaign
        A checked campaign.

    Returns
    -------
    ContactSensors or None
        None where the campaign has no ``[sensors]``.

    Raises
    ------
    TableError, LaserFormatError
        If a file is no table, a column is no temperature, names and places do not belong to each other, or no sensor is sound.
    """
    table, plan = campaign.sensors, campaign.plan
    if table is None or plan is None or plan.size_mm is None:
        return None
    path = campaign.resolve(table.file)
    logged = bring_to_utc(read_drivers(path), campaign.zone_of("sensors"), file=table.file)
    columns = []
    for name, column in logged.data_vars.items():
        try:
            factor, offset = conversion(str(column.attrs["units"]), "degC")
        except QuantityError as error:
            raise TableError(f'{path}: the column "{name}": {error}') from None
        columns.append(column * factor + offset)
    names = [str(name) for name in logged.data_vars]
    places = _read_places(campaign.resolve(table.places), names, plan.size_mm)
    temperature = xr.concat(columns, xr.IndexVariable("sensor", names), join="override").transpose("time", "sensor")
    temperature["time"].attrs.update(logged["time"].attrs)
    x_mm, y_mm = np.array([places[name] for name in names]).T
    return ContactSensors(table.file, temperature, x_mm, y_mm, table.temperature_u_K, _faults(temperature, path))


def _faults(temperature: xr.DataArray, path: Path) -> tuple[SensorFault, ...]:
    """What is clearly wrong with sensors; refused where none is sound."""
    times = temperature["time"].values
    seconds = np.asarray((times - times[0]) / np.timedelta64(1, "s"), float)
    faults = tuple(fault for fault in examine_sensors(seconds, temperature.values) if fault.is_clear)
    if len(faults) == temperature.sizes["sensor"]:
        named = "; ".join(f"{temperature['sensor'].values[fault.sensor]} {fault.words}" for fault in faults)
        raise TableError(f"{path}: no contact sensor is sound ({named}); repeat the test, or remove [sensors]")
    return faults


def _read_places(path: Path, names: list[str], size_mm: tuple[float, float]) -> dict[str, tuple[float, float]]:
    """Read ``name,x_mm,y_mm`` of every sensor, each on the plan."""
    table = read_table(path, ("name", "x_mm", "y_mm"))
    places: dict[str, tuple[float, float]] = {}
    for line, fields in table.records():
        if fields is None:
            raise TableError(f"{path}, line {line}: it does not have the fields of the heading; write name,x_mm,y_mm")
        try:
            place = (table.number(fields["x_mm"]), table.number(fields["y_mm"]))
        except BadReading as fault:
            raise TableError(f"{path}, line {line}: {fault.reason}; write the place in mm") from None
        if not (0.0 <= place[0] <= size_mm[0] and 0.0 <= place[1] <= size_mm[1]):
            raise TableError(
                f"{path}, line {line}: x {place[0]:g} mm, y {place[1]:g} mm lies beside the plan of {size_mm[0]:g} x {size_mm[1]:g} mm; "
                "correct the place, or plan.size"
            )
        places[fields["name"].strip()] = place
    strange = sorted(set(names) ^ set(places))
    if strange:
        raise TableError(
            f"{path}: {', '.join(strange)} stands in only one of both files; every sensor needs a column of temperatures and a place"
        )
    return places
