"""Random campaigns of the twin with small pictures: any size, any option of the campaign file, logs and readings that are missing."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from fusion.twin.effects import EFFECTS
from fusion.twin.instruments import write_campaign
from fusion.twin.recipe import EffectRecipe, Recipe, RecipeError
from fusion.twin.simulate import simulate

#: Most readings of a campaign, so that a thousand of them take hours and not days.
_MOST_READINGS = 6_000
#: Options of the campaign file by the table in which they stand; one of each list, or none, is taken.
_OPTIONS = {
    "thermography": (
        ['emissivity = "0.97 +- 0.01"', "emissivity = 0.5", 'reflected_temperature = "30 degC"'],
        ["camera_scale_u = 0.02", 'camera_drift_u = "0.1 K"', 'camera_offset_u = "1 K"'],
        ['window = "10 min"', "reference_patch = [2, 2, 6, 6]", "relative_humidity = 0.9"],
    ),
    "interferometry": (
        ['dead_path = "300 mm"', 'dead_path = "-50 mm"'],
        ['compensation = "redo"', 'material_temperature = "camera"'],
        ['time_zone = "UTC"', 'time_zone = "Europe/Vienna"'],
    ),
    "model": (
        [
            "declared = []",
            'declared = ["axis_expansion"]',
            'declared = ["axis_expansion", "table_offset", "thermal_lag"]',
        ],
    ),
    "campaign": (['axis = "Z\'"', 'title = "<b>&\\"=1+1"'], ['time_zone = "Asia/Tokyo"']),
    "accept": (["doubts = []"],),
}


def write_random_campaign(number: int, folder: Path) -> Path:
    """Write a campaign that depends on its number alone.

    Parameters
    ----------
    number : int
    folder : Path
        Absent; its parent exists.

    Returns
    -------
    Path
        The campaign file.
    """
    rng = np.random.default_rng([19, number])
    for attempt in range(50):
        try:
            truth = simulate(_recipe(rng))
        except RecipeError:
            continue
        campaign = write_campaign(truth, folder / str(attempt))
        _thin_out(campaign.parent, rng)
        campaign.write_text(_options(campaign.read_text(), rng))
        return campaign
    raise AssertionError(f"campaign {number}: fifty recipes that cannot be simulated")


def _recipe(rng: np.random.Generator) -> Recipe:
    targets = round(math.exp(rng.uniform(math.log(2), math.log(400.4))))
    cycles = round(math.exp(rng.uniform(math.log(2), math.log(min(500.4, _MOST_READINGS / 2 / targets)))))
    spacing = 300.0 / max(targets - 1, 1)
    effects = rng.choice(sorted(EFFECTS), size=int(rng.integers(0, 4)), replace=False)
    dwell = float(rng.uniform(0.5, 3.0))
    period = 2.0 * targets * (dwell + spacing / 5.0) + 60.0
    return Recipe().vary(
        campaign={"seed": int(rng.integers(1, 1 << 30))},
        test={
            "cycles": cycles, "targets": targets, "spacing_mm": spacing, "jitter_mm": spacing * float(rng.choice([0.0, 0.2])),
            "dwell_s": dwell, "period_s": period * float(rng.uniform(1.0, 4.0)),
            "missing_fraction": float(rng.choice([0.0, 0.0, 0.02, 0.4])),
        },
        duty={"kind": str(rng.choice(["random", "constant", "switched"])), "mean_hold_min": float(rng.uniform(3.0, 60.0))},
        drift={"walk": str(rng.choice(["none", "random_walk", "integrated", "ou"]))},
        laser={"noise_um": float(10.0 ** rng.uniform(-2.0, 0.5)), "tails": str(rng.choice(["normal", "t4"])),
               "file": str(rng.choice(["csv", "csv", "rtl"]))},
        camera={
            "columns": 160, "rows": 120, "focal_px": 1530.0 * 160 / 640, "blur_px": 0.4,
            "frames_per_cycle": int(rng.integers(1, 4)), "file": str(rng.choice(["jpg", "seq"])),
            "clock_offset_s": float(rng.choice([0.0, 7.5])), "state_clock_offset": bool(rng.random() < 0.7),
            "knock_cycle": int(rng.choice([0, 0, 0, max(cycles // 2, 1)])), "bad_pixels": int(rng.choice([0, 3])),
        },
        plan={"fiducial_diameter_mm": 40, "fiducials_x_mm": (60, 350, 640, 60, 350, 640), "fiducials_y_mm": (30, 32, 35, 145, 150, 148)},
        effect=tuple(EffectRecipe(str(name), float(rng.uniform(0.2, 5.0))) for name in effects),
    )  # fmt: skip


def _thin_out(folder: Path, rng: np.random.Generator) -> None:
    """Take away frames, readings of one approach, readings of a pause, and parts of the logs."""
    for path in sorted((folder / "thermal").glob("*.jpg")):
        if rng.random() < 0.03:
            path.unlink()
    laser = folder / "laser.csv"
    if laser.exists():
        header, *rows = laser.read_text().splitlines()
        if rng.random() < 0.2:
            rows = [row for row in rows if ",positive," in row]
        if rng.random() < 0.2:
            start = int(rng.integers(len(rows)))
            del rows[start : start + int(rng.integers(1, len(rows) // 3 + 2))]
        laser.write_text("\n".join([header, *rows]) + "\n")
    for name in ("environment.csv", "drivers.csv"):
        header, *rows = (folder / name).read_text().splitlines()
        kept = rows[: int(len(rows) * rng.choice([1.0, 1.0, 0.6, 0.1]))]
        (folder / name).write_text("\n".join([header, *kept]) + "\n")


def _options(text: str, rng: np.random.Generator) -> str:
    """Leave an instrument or a log out, and set options."""
    tables = {found[1]: found[0] for found in re.finditer(r"^\[([\w.]+)\]\n(?:(?!\[[a-z]).*\n?)*", text, re.M)}
    left_out = rng.choice(["", "", "", "", "thermography", "interferometry", "drivers", "environment"])
    tables.pop(left_out, None)
    if left_out == "thermography":
        del tables["plan"], tables["plan.axis"]
        tables["model"] = "[model]\ndeclared = []\n"
    if left_out == "environment":
        tables["interferometry"] = re.sub(r"^environment.*\n", "", tables["interferometry"], flags=re.M)
    tables.setdefault("accept", "[accept]\n")
    for table, lists in _OPTIONS.items():
        for options in lists if table in tables else ():
            if rng.random() < 0.12:
                option = str(rng.choice(options))
                key = option.split(" = ")[0]
                tables[table] = (
                    re.sub(rf"^{key} = .*\n", "", tables[table], flags=re.M).rstrip("\n") + f"\n{option}\n\n"
                )
    if "plan" in tables:
        tables["plan"] = tables["plan"].replace('"5 mm"', f'"{rng.choice([10, 20])} mm"')
    return "\n".join(tables.values())


def broken_invariants(results: dict[str, Any]) -> list[str]:
    """Return what must not be in results.json: values that are not finite, uncertainties below zero, a verdict against its steps."""
    faults: list[str] = []

    def walk(value: Any, place: str) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(inner, f"{place}.{key}")
        elif isinstance(value, list):
            for index, inner in enumerate(value):
                walk(inner, f"{place}[{index}]")
        elif isinstance(value, float):
            key = place.rsplit(".", 1)[-1].split("[")[0]
            if not math.isfinite(value):
                faults.append(f"{place} = {value}")
            elif value < 0.0 and (
                key in ("u", "p_value") or "_u_" in key or key.startswith("rmse") or key.endswith("rms_um")
            ):
                faults.append(f"{place} = {value} is negative")

    walk(results, "results")
    loop = results.get("loop")
    if loop is not None:
        steps, verdict = [step for step in loop["steps"] if step.get("borne_out") != "no"], loop["verdict"]
        if (verdict == "complete" and steps) or (verdict in ("explained", "partial") and not loop["steps"]):
            faults.append(f"verdict {verdict} with {len(loop['steps'])} steps")
    return faults


def strict(path: Path) -> dict[str, Any]:
    """Read JSON without NaN and infinities."""

    def refuse(text: str) -> None:
        raise AssertionError(f"{path} holds {text}")

    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    return content
