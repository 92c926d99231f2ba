"""Campaign files that lie: each lie is one edit of a sound campaign folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pandas as pd


def _laser(folder: Path, column: str, values: Callable[[pd.DataFrame], pd.Series]) -> None:
    table = pd.read_csv(folder / "laser.csv")
    table[column] = values(table)
    table.to_csv(folder / "laser.csv", index=False)


def deviations_in_mm(folder: Path) -> None:
    """Deviations in mm where um are asked for."""
    _laser(folder, "deviation_um", lambda table: table["deviation_um"] / 1000.0)


def deviations_in_nm(folder: Path) -> None:
    """Deviations in nm where um are asked for."""
    _laser(folder, "deviation_um", lambda table: table["deviation_um"] * 1000.0)


def positions_in_inch(folder: Path) -> None:
    """Positions in inch where mm are asked for."""
    _laser(folder, "position_mm", lambda table: table["position_mm"] / 25.4)


def inverted_signs(folder: Path) -> None:
    """Deviations with the opposite sign."""
    _laser(folder, "deviation_um", lambda table: -table["deviation_um"])


def new_datum(folder: Path) -> None:
    """The beam was broken before cycle 15."""
    _laser(folder, "deviation_um", lambda table: table["deviation_um"] + 80.0 * (table["cycle"] >= 15))


def copied_cycle(folder: Path) -> None:
    """Cycle 13 holds the deviations of cycle 12."""

    def copied(table: pd.DataFrame) -> pd.Series:
        deviation = table["deviation_um"].copy()
        deviation[table["cycle"] == 13] = deviation[table["cycle"] == 12].to_numpy()
        return deviation

    _laser(folder, "deviation_um", copied)


def drivers_of_another_day(folder: Path) -> None:
    """The drivers' log of the day before."""
    table = pd.read_csv(folder / "drivers.csv", parse_dates=["time"])
    table["time"] = table["time"] - pd.Timedelta(days=1)
    table.to_csv(folder / "drivers.csv", index=False, date_format="%Y-%m-%dT%H:%M:%S.%f+00:00")


def drivers_end_early(folder: Path) -> None:
    """The drivers' log stops after half of the test."""
    table = pd.read_csv(folder / "drivers.csv")
    table.head(len(table) // 2).to_csv(folder / "drivers.csv", index=False)


def _campaign_file(folder: Path, **changed: str) -> None:
    """Lines of campaign.toml by key, each written anew."""
    path = folder / "campaign.toml"
    lines = path.read_text(encoding="utf-8").splitlines()
    assert changed.keys() <= {line.partition(" =")[0] for line in lines}
    written = [f"{key} = {changed[key]}" if (key := line.partition(" =")[0]) in changed else line for line in lines]
    path.write_text("\n".join(written) + "\n", encoding="utf-8")


def axis_the_other_way_round(folder: Path) -> None:
    """The same stretch of the plan with its direction reversed."""
    _campaign_file(folder, origin='["250 mm", "90 mm"]', direction="[1, 0]")
