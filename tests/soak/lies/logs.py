"""Logs that lie: missing, ending early, columns exchanged, sensors that stand still."""

from __future__ import annotations

import numpy as np
import pandas as pd

from tests.soak.lies.folder import edit_column, edit_table, key
from tests.soak.lies.lie import Lie

ENVIRONMENT = r"environment"
DRIVERS = r"drivers|duty|load"
MATERIAL = r"material"


def first_half(table: pd.DataFrame) -> pd.DataFrame:
    return table.head(len(table) // 2)


def exchanged(table: pd.DataFrame) -> pd.DataFrame:
    air, material = "air_temperature_degC", "material_temperature_degC"
    return table.assign(**{air: table[material], material: table[air]})


def of_another_test(duty: np.ndarray) -> np.ndarray:
    """A load of the same kind, drawn anew."""
    rng = np.random.default_rng(5)
    changes = np.cumsum(rng.random(duty.size) < 1.0 / 25.0)
    return np.round(rng.random(changes[-1] + 1)[changes], 3)


LIES = (
    Lie("environment log missing for the second half", ENVIRONMENT, edit_table("environment.csv", first_half)),
    Lie("environment log missing", ENVIRONMENT, key("interferometry", "environment", None)),
    Lie("columns of air and material exchanged", MATERIAL + "|air", edit_table("environment.csv", exchanged)),
    Lie(
        "material sensor stands still",
        MATERIAL,
        edit_column("environment.csv", "material_temperature_degC", lambda c: np.full(c.size, c[0])),
    ),
    Lie(
        "material sensor in the coolant: 8 K too high",
        MATERIAL,
        edit_column("environment.csv", "material_temperature_degC", lambda c: c + 8.0),
    ),
    Lie("drivers log missing for the second half", DRIVERS, edit_table("drivers.csv", first_half)),
    Lie("drivers log with the load of another test", DRIVERS, edit_column("drivers.csv", "duty [1]", of_another_test)),
    Lie("drivers log stands still", DRIVERS, edit_column("drivers.csv", "duty [1]", lambda d: np.full(d.size, d[0]))),
    Lie("drivers log inverted (1 - load)", DRIVERS, edit_column("drivers.csv", "duty [1]", lambda d: 1.0 - d)),
    Lie(
        "drivers log once an hour",
        DRIVERS,
        edit_table("drivers.csv", lambda table: table.iloc[::60]),
    ),
)
