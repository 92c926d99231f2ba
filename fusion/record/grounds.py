"""Grounds of a record: excitation by its drivers, noise of its sensors, and the course of a delayed sensor.

Answers for one sensor and for the load's own course what :mod:`fusion.loop.admissibility` asks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusion._typing import Array
from fusion.effects.effect import Candidate
from fusion.loop.admissibility import NOISE_SHARE
from fusion.loop.decisions import Decision, Reason
from fusion.record.blocks import Record
from fusion.record.model import RecordFit, channel_gains
from interferometry.drift.gls import fit_fixed_effects

#: A driver of which a single step explains more than this share was switched only once.
_ONE_SWITCHING = 0.99


class RecordGrounds:
    """Grounds of a record: the record and a model of it without the candidate.

    Parameters
    ----------
    model : RecordFit
        Without the candidate.
    least_gain : float
        Log-likelihood that an event has to gain beside a shift at a switching, or it only stands in for that one.
    """

    def __init__(self, model: RecordFit, *, least_gain: float = 0.0) -> None:
        self._model = model
        self._record = model.record
        self._least_gain = least_gain

    def is_admissible(self, candidate: Candidate) -> bool:
        """Whether nothing speaks against a candidate before any fit: it is no event at a switching, and no lag of a noisy sensor."""
        if candidate.event_s is not None:
            return not self._is_switched(candidate.event_s)
        if "sensor" not in candidate.parameters:
            return True
        _, noise, limit = self.noise_of_lag(candidate)
        return noise <= limit

    def _is_switched(self, event_s: float) -> bool:
        return bool(self._record.switched()[np.searchsorted(self._record.seconds, event_s)])

    def at_switching(self, candidate: Candidate) -> float | None:
        """Hours since the start of the switching at which an event happened, or whose response it stands in for."""
        if candidate.event_s is None:
            return None
        if self._is_switched(candidate.event_s):
            return candidate.event_s / 3600.0
        if self._least_gain <= 0.0:
            return None
        record = self._record
        shifts = [
            Candidate((record.seconds >= instant).astype(float)[:, None], {}, ("um",), float(instant))
            for instant in record.seconds[record.switched() & self._model.used]
        ]
        if not shifts:
            return None
        rival = shifts[int(np.argmax(channel_gains(self._model, shifts).gain[:, 0]))]
        both = replace(candidate, columns=np.column_stack([candidate.columns, rival.columns]), beside=1)
        gain = float(channel_gains(self._model, [both]).gain[0, 0])
        return None if gain >= self._least_gain else float(rival.event_s or 0.0) / 3600.0

    def heat_is_logged(self) -> bool:
        """Whether a driver was logged."""
        return bool(self._record.drivers)

    def noise_of_lag(self, candidate: Candidate) -> tuple[str, float, float]:
        """Noise of a block mean of the delayed sensor over the range of its rise."""
        name = str(candidate.parameters["sensor"])
        rise = _sensor_rise(self._record, name)[self._model.used]
        return name, _sensor_noise(self._record, name) / max(float(np.ptp(rise)), 1e-12), NOISE_SHARE

    def refuse_single_excitation(self, effect: str, excited_by: str, candidate: Candidate) -> Decision | None:
        """Refuse a source whose driver was switched only once: all single warm-ups are alike."""
        if excited_by != "driver":
            return None
        driver = str(candidate.parameters["follows"])
        share = one_switching_share(self._record.drivers[driver][1][self._model.used])
        if share <= _ONE_SWITCHING:
            return None
        return Decision(effect, Reason.SINGLE_SWITCHING, {"driver": driver, "share_percent": 100.0 * share})

    def follows_rate(self, candidate: Candidate) -> bool:
        """Whether most of what a delayed copy explains is the sensor's rate, or acts before the sensor.

        Alike sensors share their coefficients in any way, so the sensitivity to a sensor is that of all columns to its course. A rate is
        the sensor and its delayed copy with opposite signs that nearly cancel; a lead is a delayed copy that acts against the sensor, whose
        own sensitivity without the copy is known to have the other sign (two standard uncertainties).
        """
        model = self._model
        rise = _sensor_rise(self._record, str(candidate.parameters["sensor"]))
        weight = {True: 0.0, False: 0.0}
        for fit, rows, levels in zip(model.channels, model.rows, model.levels, strict=True):
            course = rise[rows] - rise[rows].mean()
            size = fit.design.shape[1]
            together = fit_fixed_effects(
                fit.system, fit.response, np.column_stack([fit.design, candidate.columns[rows]])
            )
            delayed = float(together.coefficients[-1])
            own = slice(levels, size)
            share = fit.design[:, own].T @ course / max(float(course @ course), 1e-300)
            alone, beside = (float(share @ each.coefficients[own]) for each in (fit, together))
            alone_u = float(np.sqrt(share @ fit.covariance[own, own] @ share))
            cancels = beside * delayed < 0.0 and abs(beside + delayed) < 0.5 * max(abs(beside), abs(delayed))
            leads = alone * delayed < 0.0 and abs(alone) > 2.0 * alone_u
            weight[cancels or leads] += abs(delayed) / max(fit.sigma, 1e-12)
        return weight[True] > weight[False]

    def advantage_over_smoothing(self, candidate: Candidate) -> float:
        """Gain over the sensor averaged over a window as wide as the lag's memory."""
        rise = _sensor_rise(self._record, str(candidate.parameters["sensor"]))
        smooth = _smoothed(self._record, rise, float(candidate.parameters["time_constant_min"]))
        gains = channel_gains(self._model, [candidate, Candidate(smooth[:, None], {}, ("um/K",))])
        return float(gains.gain[0, 0] - gains.gain[1, 0])


def _sensor_rise(record: Record, name: str) -> Array:
    """Rise of one sensor, or of the mean of all, K (blocks,)."""
    return record.rise[:, record.sensors.index(name)] if name in record.sensors else record.rise.mean(axis=1)


def _sensor_noise(record: Record, name: str) -> float:
    """Noise of a block mean of one sensor, or of the mean of all, K."""
    if name in record.sensors:
        return float(record.temperature_noise[record.sensors.index(name)])
    return float(np.sqrt(np.mean(record.temperature_noise**2) / len(record.sensors)))


def _smoothed(record: Record, values: Array, minutes: float) -> Array:
    """Mean over a centred window as wide as the lag's memory, without delay, (blocks,)."""
    half = max(1, round(60.0 * minutes / record.block_s))
    place = np.arange(values.size)
    begin = np.asarray(record.first)[record.run]
    end = np.array([*record.first[1:], values.size])[record.run]
    first, last = np.maximum(place - half, begin), np.minimum(place + half + 1, end)
    total = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray((total[last] - total[first]) / (last - first))


def one_switching_share(driver: Array) -> float:
    """Share of a driver's variance that the best single step explains.

    Parameters
    ----------
    driver : (blocks,) in any unit

    Returns
    -------
    float
        Between 0 and 1; 1 for a load that was switched once.
    """
    n = driver.size
    before = np.cumsum(driver)[:-1]
    count = np.arange(1, n)
    between = (before / count - (driver.sum() - before) / (n - count)) ** 2 * count * (n - count) / n
    return float(between.max() / max(float(((driver - driver.mean()) ** 2).sum()), 1e-300))
