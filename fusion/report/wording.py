"""Numbers and verdicts in plain words: sensible digits, units, uncertainty, and what to do next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

#: Effect -> its name in plain words, and what to look at on the machine or the measurement when it was found missing.
EFFECTS: dict[str, tuple[str, str]] = {
    "quasi_static": (
        "quasi-static response to the temperatures",
        "Check that the sensors sit on the parts that move the tool and the work.",
    ),
    "axis_expansion": (
        "expansion of the axis",
        "Check the expansion coefficient and the probe place that the laser's compensation uses.",
    ),
    "table_offset": (
        "shift with the table's mean temperature",
        "Look at the thermal path from table to scale and at the table's clamping.",
    ),
    "thermal_lag": (
        "thermal lag of a remote structure",
        "Wait longer before measuring, or log the temperature of the column and the bed.",
    ),
    "unseen_heat_source": (
        "unseen heat source",
        "Look for it where neither camera nor sensors reach: spindle, motor, drive, screw bearing, hydraulics; log its duty.",
    ),
    "dead_path": (
        "dead path of the laser",
        "Shorten the dead path or enter it, and zero the laser where the optics are closest.",
    ),
    "air_index": (
        "refractive index of the air",
        "Check that the weather station was on, and that its air sensor is in the beam's air.",
    ),
    "material_compensation": (
        "material compensation",
        "Check the coefficient that was entered and where the material probe sat.",
    ),
    "angular_growth": (
        "growing pitch or yaw of the axis",
        "Measure pitch and yaw while the machine warms up; keep the Abbe offset short.",
    ),
    "reversal_drift": (
        "reversal that changes with time",
        "Check screw preload, gibs and the scale's coupling; measure the reversal warm and cold.",
    ),
    "step_event": (
        "sudden step",
        "Look at the clamping of optics and laser head, and at what happened at that time.",
    ),
    "periodic_disturbance": (
        "periodic disturbance",
        "Compare its period with coolant, hydraulics and air conditioning.",
    ),
    "pitch_error": (
        "pitch error of the screw",
        "Repeat with a target spacing that is no multiple of the screw's lead.",
    ),
    "camera_offset": (
        "jump of the camera's zero",
        "Let the camera warm up and watch its flat-field corrections; the fields before and after the jump differ.",
    ),
    "reflected_source": (
        "reflection in the picture",
        "Shield the reflecting source, or paint the reflecting part.",
    ),
    "laser_warm_up": (
        "warm-up of the laser",
        "Let the laser warm up longer before the first cycle.",
    ),
    "sensor_fault": (
        "faulty sensor",
        "Check the sensor named, and its cable and time stamps.",
    ),
}

#: Cause of an anomaly -> plain words and what to check.
CAUSES: dict[str, tuple[str, str]] = {
    "structural": (
        "scatter of the structure",
        "Check guideway, scale and screw at this position for wear, dirt or play.",
    ),
    "local_temperature": (
        "local temperature",
        "Check what heats the table near this position, and whether the fixture bends with it.",
    ),
    "stick_slip": (
        "stick-slip",
        "Check lubrication and guideway friction around this position; repeat with another feed rate.",
    ),
    "step": ("sudden step", "Check clamping and scale coupling; look at what happened at that time."),
    "undetermined": (
        "undetermined",
        "These data do not decide. Repeat with more cycles around this position, in both directions.",
    ),
}


#: How the remedy of a warning starts that asks for no action.
NOTHING_TO_DO = "Nothing has to be done"


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with significant digits and a true minus sign, or a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}".replace("-", "−")


def decimals_of(u: float) -> int:
    """Return how many decimals show an expanded uncertainty 2 u with two significant digits."""
    return max(0, 1 - math.floor(math.log10(2 * u))) if u > 0 and math.isfinite(u) else 2


def measured(value: float | None, u: float | None, unit: str = "", *, decimals: int | None = None) -> str:
    """Return ``value ± U unit`` with U = 2 u to two significant digits, or to `decimals`, and the value to the same place."""
    tail = f" {unit}" if unit else ""
    if value is None or not math.isfinite(value):
        return "–"
    if u is None or not math.isfinite(u) or u <= 0:
        return f"{number(value)}{tail}"
    places = decimals_of(u) if decimals is None else decimals
    return f"{value:.{places}f} ± {2 * u:.{places}f}{tail}".replace("-", "−")


def p_value(p: float | None) -> str:
    """Return a p-value to two digits, or as a bound where it is tiny."""
    if p is None or not math.isfinite(p):
        return "–"
    return "< 0.001" if p < 0.001 else f"{p:.2g}"


def duration(seconds: float) -> str:
    """Return a time span in the unit that reads best."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def moment(time: np.datetime64) -> str:
    """Return a UTC time to the minute."""
    return "–" if np.isnat(time) else f"{np.datetime_as_string(time, unit='m').replace('T', ' ')} UTC"


def join(items: Sequence[str]) -> str:
    """Return ``a, b and c``."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}" if items else ""


def effect_name(name: str) -> str:
    """Return an effect's name in plain words."""
    return EFFECTS[name][0] if name in EFFECTS else name.replace("_", " ")


def verdict_headline(loop: Mapping[str, Any]) -> str:
    """Return one sentence that states what the closed loop found."""
    added = join([effect_name(step["effect"]) for step in loop["steps"]])
    left = loop["unexplained"]["shape"] or "without a clear shape"
    noun, pronoun = ("an effect", "it") if len(loop["steps"]) == 1 else (f"{len(loop['steps'])} effects", "them")
    return {
        "complete": "The declared model explains the drift; nothing in these data shows that an effect is missing.",
        "explained": f"The declared model lacked {noun}: {added}. With {pronoun}, nothing is left that these data can show.",
        "partial": f"The declared model lacked {noun}: {added}. With {pronoun}, something without a name is left ({left}).",
        "unexplained": f"Something is left that no effect of the library explains ({left}).",
    }[loop["verdict"]]


def verdict_numbers(loop: Mapping[str, Any]) -> str:
    """Return the sentence with the held-out errors and the noise beside them."""
    floor = number(loop["noise_floor_um"], 2)
    if not loop["steps"]:
        return f"Error on held-out cycles: {number(loop['rmse_declared_um'], 2)} µm; the noise of single readings is {floor} µm."
    return (
        f"Error on held-out cycles: {number(loop['rmse_declared_um'], 2)} µm with the declared model, "
        f"{number(loop['rmse_final_um'], 2)} µm after; the noise of single readings is {floor} µm."
    )


def next_steps(results: Mapping[str, Any]) -> list[str]:
    """Return what to do next: first what the loop found, then the anomalies, then the warnings' remedies."""
    loop = results.get("loop") or {"steps": [], "verdict": "complete"}
    steps = [EFFECTS[step["effect"]][1] for step in loop["steps"] if step["effect"] in EFFECTS]
    if loop["verdict"] in {"partial", "unexplained"}:
        steps.append(
            "Log more of what happens at the machine (duty, coolant, doors, air) in the next test: what is left has no name."
        )
    for anomaly in results.get("anomalies") or []:
        steps.append(f"Position {anomaly['target']}: {CAUSES[anomaly['cause']][1]}")
    steps += [warning["remedy"] for warning in results["warnings"] if not warning["remedy"].startswith(NOTHING_TO_DO)]
    unique = list(dict.fromkeys(step for step in steps if step))
    return unique or [f"{NOTHING_TO_DO}: use the profile and its uncertainty as they are."]
