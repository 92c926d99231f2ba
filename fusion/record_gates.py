"""L4 - Reasons not to name an effect of a record although it fits: too little excitation, or a sensor too noisy to carry a lag.

The same questions as along an axis (:mod:`fusion.gates`), asked of one sensor and of the load's own course.
"""

from __future__ import annotations

import numpy as np

from fusion.members import Member
from fusion.record import Record
from fusion.record_effects import RecordEffect
from fusion.record_model import RecordFit, gains
from interferometry.statespace import Array

#: Temperature noise over range beyond which a lag is not believed (statistics study, section 3.4).
_NOISE_SHARE = 0.01
#: A load state of which one plain warm-up explains more than this share has been excited by nothing else.
_WARM_UP_SHARE = 0.99
#: Log-likelihood that a lag must gain over a copy that is only smoothed.
_SMOOTH_GAIN = 2.0
_WARM_UPS_MIN = np.geomspace(5.0, 400.0, 40)


def blocked_reason(effect: RecordEffect, member: Member, model: RecordFit) -> str | None:
    """Why this effect must not be named although it fits, or None."""
    record = model.record
    if effect.name == "unseen_heat_source":
        share = warm_up_share(record, member.columns[model.used])
        if share > _WARM_UP_SHARE:
            return (
                f"the load was switched on once only ({100 * share:.1f} % of the source's course is a plain warm-up), and one warm-up "
                "looks like every other; switch the load on purpose to tell"
            )
    if effect.name == "step_event" and member.event_s is not None:
        if record.switched()[np.searchsorted(record.seconds, member.event_s)]:
            return f"at {member.event_s / 3600.0:.2f} h a driver was switched: a shift there is a response to the load, not an event of its own"
    if effect.name == "thermal_lag":
        rise = sensor_rise(record, str(member.parameters["sensor"]))
        noise = sensor_noise(record, str(member.parameters["sensor"])) / max(float(np.ptp(rise[model.used])), 1e-12)
        if noise > _NOISE_SHARE:
            return (
                f"the noise of {member.parameters['sensor']} is {100 * noise:.1f} % of its range; above {100 * _NOISE_SHARE:g} % a "
                "lagged, smoother copy wins by its smoothness alone"
            )
        smooth = Member(smoothed(record, rise, float(member.parameters["time_constant_min"]))[:, None], {}, ("um/K",))
        found, _ = gains(model, [np.empty((rows.size, 0)) for rows in model.rows], [member, smooth])
        advantage = float(found[0, 0] - found[1, 0])
        if advantage < _SMOOTH_GAIN:
            return (
                f"a copy of the sensor that is only smoothed, not delayed, fits as well (log-likelihood {advantage:+.1f}): the lag "
                "wins by denoising, not by physics"
            )
    return None


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


def warm_up_share(record: Record, columns: Array) -> float:
    """Share of the columns' course that one plain warm-up from the record's start explains (least of the columns)."""
    seconds = record.seconds[: columns.shape[0]]
    curves = [1.0 - np.exp(-seconds / (60.0 * minutes)) for minutes in _WARM_UPS_MIN]
    return min(1.0 - min(_left(column, curve) for curve in curves) for column in columns.T)


def _left(course: Array, curve: Array) -> float:
    basis = np.column_stack([np.ones(course.size), curve])
    left = course - basis @ np.linalg.lstsq(basis, course, rcond=None)[0]
    return float(left @ left) / max(float(((course - course.mean()) ** 2).sum()), 1e-300)
