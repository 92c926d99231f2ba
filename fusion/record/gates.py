"""Reasons not to name an effect of a record although it fits: too little excitation, or a sensor too noisy to carry a lag.

The same questions as along an axis (:mod:`fusion.loop.admissibility`), asked of one sensor and of the load's own course.
"""

from __future__ import annotations

import numpy as np

from fusion._typing import Array
from fusion.effects.candidates import Candidate
from fusion.record.blocks import Record
from fusion.record.effects import RecordEffect
from fusion.record.model import RecordFit, gains
from interferometry.drift.gls import fit_fixed_effects

#: Temperature noise over range beyond which a lag is not believed (statistics study, section 3.4).
_NOISE_SHARE = 0.01
#: A driver of which one switching explains more than this share was switched once only.
_ONE_SWITCHING = 0.99
#: Log-likelihood that a lag must gain over a copy that is only smoothed.
_SMOOTH_GAIN = 2.0


def blocked_reason(effect: RecordEffect, candidate: Candidate, model: RecordFit) -> str | None:
    """Why this effect must not be named although it fits, or None."""
    record = model.record
    if candidate.event_s is not None and record.switched()[np.searchsorted(record.seconds, candidate.event_s)]:
        hours = f"{candidate.event_s / 3600.0:.2f} h"
        return f"at {hours} a driver was switched: a shift there is a response to the load, not an event of its own"
    if effect.name == "unseen_heat_source":
        driver = str(candidate.parameters["follows"])
        share = one_switching_share(record.drivers[driver][1][model.used])
        if share > _ONE_SWITCHING:
            return (
                f"{driver} was switched once only ({100 * share:.1f} % of its course is one step), and one warm-up looks like every "
                "other; switch the load on purpose to tell"
            )
    if effect.name == "thermal_lag":
        rise = sensor_rise(record, str(candidate.parameters["sensor"]))
        noise = sensor_noise(record, str(candidate.parameters["sensor"])) / max(float(np.ptp(rise[model.used])), 1e-12)
        if noise > _NOISE_SHARE:
            return (
                f"the noise of {candidate.parameters['sensor']} is {100 * noise:.1f} % of its range; above {100 * _NOISE_SHARE:g} % a "
                "lagged, smoother copy wins by its smoothness alone"
            )
        if _follows_the_rate(model, rise, candidate):
            return (
                f"with the delayed copy of {candidate.parameters['sensor']} the displacement follows the rate of the sensor or leads it, "
                "as with a late sensor or a source nearby; that is not a lag"
            )
        smooth = Candidate(
            smoothed(record, rise, float(candidate.parameters["time_constant_min"]))[:, None], {}, ("um/K",)
        )
        found, _ = gains(model, [candidate, smooth])
        advantage = float(found[0, 0] - found[1, 0])
        if advantage < _SMOOTH_GAIN:
            return (
                f"a copy of the sensor that is only smoothed, not delayed, fits as well (log-likelihood {advantage:+.1f}): the lag "
                "wins by denoising, not by physics"
            )
    return None


def _follows_the_rate(model: RecordFit, rise: Array, candidate: Candidate) -> bool:
    """True where most of what a delayed copy explains is the sensor's rate, or acts before the sensor.

    Alike sensors share their coefficients in any way, so the sensitivity to a sensor is that of all columns to its course. A rate is
    the sensor and its delayed copy with opposite signs that nearly cancel; a lead is a delayed copy that acts against the sensor.
    """
    weight = {True: 0.0, False: 0.0}
    for fit, rows in zip(model.channels, model.rows, strict=True):
        course = rise[rows] - rise[rows].mean()
        size = fit.design.shape[1]
        found = fit_fixed_effects(fit.system, fit.response, np.column_stack([fit.design, candidate.columns[rows]]))
        delayed = float(found.coefficients[-1])
        alone, beside = (
            float((fit.design[:, 1:] @ coefficients[1:size]) @ course) / max(float(course @ course), 1e-300)
            for coefficients in (fit.coefficients, found.coefficients)
        )
        cancels = beside * delayed < 0.0 and abs(beside + delayed) < 0.5 * max(abs(beside), abs(delayed))
        weight[cancels or alone * delayed < 0.0] += abs(delayed) / fit.sigma
    return weight[True] > weight[False]


def sensor_rise(record: Record, name: str) -> Array:
    """Rise of one sensor, or of the mean of all, K (blocks,)."""
    return record.rise[:, record.sensors.index(name)] if name in record.sensors else record.rise.mean(axis=1)


def sensor_noise(record: Record, name: str) -> float:
    """Noise of a block mean of one sensor, or of the mean of all, K."""
    if name in record.sensors:
        return float(record.temperature_noise[record.sensors.index(name)])
    return float(np.sqrt(np.mean(record.temperature_noise**2) / len(record.sensors)))


def smoothed(record: Record, values: Array, minutes: float) -> Array:
    """Mean over a centred window as wide as the lag's memory, without delay, (blocks,)."""
    half = max(1, round(60.0 * minutes / record.block_s))
    kernel = np.ones(2 * half + 1)
    return np.asarray(np.convolve(values, kernel, "same") / np.convolve(np.ones_like(values), kernel, "same"))


def one_switching_share(driver: Array) -> float:
    """Share of a driver's variance that the best single step explains."""
    n = driver.size
    before = np.cumsum(driver)[:-1]
    count = np.arange(1, n)
    between = (before / count - (driver.sum() - before) / (n - count)) ** 2 * count * (n - count) / n
    return float(between.max() / max(float(((driver - driver.mean()) ** 2).sum()), 1e-300))
