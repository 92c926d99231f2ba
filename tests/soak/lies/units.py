"""Units that lie: numbers in another unit than their heading says, and decimal marks misread."""

from __future__ import annotations

import numpy as np

from tests.soak.lies.campaigns import HALF
from tests.soak.lies.folder import edit_column, edit_table, key
from tests.soak.lies.lie import Lie

DEVIATION = r"deviation.*(unit|mm\b|magnitude|digits|decimal)|unit.*deviation"
POSITION = r"(position|target|travel|plan|axis).*(unit|mm\b)"
FIDUCIAL = r"fiducial|disc|plan|registration"
AIR = r"air_temperature|air temperature|environment"
PRESSURE = r"pressure"
HUMIDITY = r"humidity"
MATERIAL = r"material"
_INCH_MM = 25.4


def deviation(factor: float):
    return edit_column("laser.csv", "deviation_um", lambda values: values * factor)


def position(factor: float):
    return edit_column("laser.csv", "position_mm", lambda values: values * factor)


def environment(column: str, change):
    return edit_column("environment.csv", column, change)


def without_decimal_point(table, rows):
    """Numbers as a program reads them that takes the decimal comma for a separator of thousands: 2,2677 becomes 22677."""
    digits = table["deviation_um"].map(lambda value: float(f"{value:.4f}".replace(".", "")))
    return table.assign(deviation_um=digits.where(rows(table), table["deviation_um"]))


LIES = (
    Lie("deviations in mm as µm (/1000)", DEVIATION, deviation(1e-3)),
    Lie("deviations in nm as µm (x 1000)", DEVIATION, deviation(1e3)),
    Lie("deviations in µinch as µm (x 39.4)", DEVIATION, deviation(1e3 / _INCH_MM)),
    Lie("deviations scaled by 1.4", DEVIATION + "|scale|coefficient", deviation(1.4)),
    Lie(
        "decimal comma lost in every deviation",
        DEVIATION,
        edit_table("laser.csv", lambda table: without_decimal_point(table, lambda rows: rows["cycle"] > 0)),
    ),
    Lie(
        "decimal comma lost in the second half",
        DEVIATION,
        edit_table("laser.csv", lambda table: without_decimal_point(table, lambda rows: rows["cycle"] >= HALF)),
    ),
    Lie("positions in m as mm (/1000)", POSITION, position(1e-3)),
    Lie("positions in µm as mm (x 1000)", POSITION, position(1e3)),
    Lie("positions in inch as mm (/25.4)", POSITION, position(1.0 / _INCH_MM)),
    Lie("positions in cm as mm (/10)", POSITION, position(0.1)),
    Lie(
        "fiducials in m as mm",
        FIDUCIAL,
        edit_table("fiducials.csv", lambda t: t.assign(x_mm=t["x_mm"] / 1e3, y_mm=t["y_mm"] / 1e3)),
    ),
    Lie(
        "fiducials in cm as mm",
        FIDUCIAL,
        edit_table("fiducials.csv", lambda t: t.assign(x_mm=t["x_mm"] / 10, y_mm=t["y_mm"] / 10)),
    ),
    Lie(
        "plan origin in m, written mm", r"plan\.axis|measured line", key("plan.axis", "origin", '["0.5 mm", "0.09 mm"]')
    ),
    Lie("air temperature in °F", AIR, environment("air_temperature_degC", lambda c: 1.8 * c + 32.0)),
    Lie("air temperature in K", AIR, environment("air_temperature_degC", lambda c: c + 273.15)),
    Lie("material temperature in °F", MATERIAL, environment("material_temperature_degC", lambda c: 1.8 * c + 32.0)),
    Lie("material temperature in K", MATERIAL, environment("material_temperature_degC", lambda c: c + 273.15)),
    Lie("humidity as a fraction", HUMIDITY, environment("relative_humidity_percent", lambda h: h / 100.0)),
    Lie("pressure in Pa", PRESSURE, environment("air_pressure_hPa", lambda p: 100.0 * p)),
    Lie("pressure in kPa", PRESSURE, environment("air_pressure_hPa", lambda p: p / 10.0)),
    Lie("pressure in mmHg", PRESSURE, environment("air_pressure_hPa", lambda p: p / 1.33322)),
    Lie(
        "load in percent",
        r"drivers|duty|load",
        edit_column("drivers.csv", "duty [1]", lambda d: np.round(100.0 * d, 1)),
    ),
)
