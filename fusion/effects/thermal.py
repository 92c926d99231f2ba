"""Heat: expansion with the seen field, its delayed copies, and sources out of the camera's sight."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from fusion.alignment.readings import Readings
from fusion.effects.effect import Candidate, Effect, Parameters, Prior
from fusion.effects.states import LAGS_MIN, first_order_responses, um_per, unmeasured_expansion, values_near

#: Standard uncertainty of an expansion coefficient from a table: steels and cast irons lie between 9 and 14 ppm/K.
EXPANSION_U_PPM_PER_K = 2.0
#: Name of the declared model of a record: every displacement a linear function of the temperatures.
QUASI_STATIC = "quasi_static"
#: Prefix of the series that are temperature sensors of a record.
SENSOR_PREFIX = "temperature "
#: Time constant of a second body that the search tries, as a share of the first one's.
_SECOND_BODY_TRIED = (0.25,)


def needs_field(readings: Readings) -> str | None:
    """Say that a campaign without thermal frames cannot show an effect, or return None.

    Parameters
    ----------
    readings : with the series of the field, if there is one
    """
    return None if "mean_rise" in readings.series else "the campaign holds no temperature of the table"


def _needs_driver(readings: Readings) -> str | None:
    return (
        None
        if readings.drivers
        else "nothing that drives a heat source was logged; log duty, speed or load as [drivers]"
    )


def _axis_expansion(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Integral of the seen rise along the measured line: K mm times 1e-6 is 1e-3 um per ppm/K."""
    yield Candidate((readings.at(readings.series["axis_integral"]) * 1e-3)[:, None], {}, ("ppm/K",))


def _table_offset(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Mean rise of the seen table."""
    yield Candidate(readings.at(readings.series["mean_rise"])[:, None], {}, ("um/K",))


def _thermal_lag(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Delayed copies of the seen temperatures, flat and along the axis."""
    # Between two frames the field is a straight line; a shorter lag is not in the data.
    frames_min = float(np.median(np.diff(readings.series["mean_rise"].seconds))) / 60.0
    for minutes in values_near(near, "time_constant_min", LAGS_MIN, ratio=1.5):
        if minutes < 2.0 * frames_min:
            continue
        axis = readings.at(readings.series["axis_integral"].lagged(60.0 * minutes)) * 1e-3
        offset = readings.at(readings.series["mean_rise"].lagged(60.0 * minutes))
        yield Candidate(offset[:, None], {"time_constant_min": minutes, "shape": "flat"}, ("um/K",))
        yield Candidate(axis[:, None], {"time_constant_min": minutes, "shape": "linear"}, ("ppm/K",))
        both: Parameters = {"time_constant_min": minutes, "shape": "flat and linear"}
        yield Candidate(np.column_stack([offset, axis]), both, ("um/K", "ppm/K"))


def _unseen_heat_source(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Responses to the logged drivers, flat and along the axis."""
    for name in readings.drivers:
        unit = um_per(readings.series[name].units)
        for lagged, response in first_order_responses(
            readings.series[name], near, LAGS_MIN, ratio=1.5, second=_SECOND_BODY_TRIED
        ):
            settled = readings.at(lagged)
            # What the body was before the log began is not known; its memory of it dies away with the same time constant.
            memory = np.exp(-readings.seconds / (60.0 * float(response["time_constant_min"])))
            for shape, along in (
                ("flat", (1.0,)),
                ("linear", (readings.share,)),
                ("flat and linear", (1.0, readings.share)),
            ):
                parameters: Parameters = {"follows": name, **response, "shape": shape}
                follow = [settled * factor for factor in along]
                start = [memory * factor for factor in along]
                per = (unit,) * len(along)
                yield Candidate(np.column_stack(follow), {**parameters, "start": "settled"}, per)
                units = per + ("um",) * len(along)
                yield Candidate(
                    np.column_stack([*follow, *start]), {**parameters, "start": "free"}, units, beside=len(along)
                )


def _quasi_static(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Rise of every temperature sensor."""
    sensors = [series for name, series in readings.series.items() if name.startswith(SENSOR_PREFIX)]
    yield Candidate(np.column_stack([readings.at(series) for series in sensors]), {}, ("um/K",) * len(sensors))


AXIS_EXPANSION = Effect(
    name="axis_expansion",
    physics="The table lengthens along the measured line as it warms: one coefficient times the integral of the seen rise.",
    source="ISO/TR 16015; steel 11.7 ppm/K",
    candidates=_axis_expansion,
    needs=needs_field,
    follows_field=True,
    prior=Prior(11.7, EXPANSION_U_PPM_PER_K),
    declarable=True,
    label="expansion of the axis",
    remedy="Check the expansion coefficient and the probe place that the laser's compensation uses.",
)
TABLE_OFFSET = Effect(
    name="table_offset",
    physics=(
        "Everything between table and laser moves together with the table's mean temperature: the same shift at all positions."
    ),
    source="ISO 230-3, thermal distortion",
    candidates=_table_offset,
    needs=needs_field,
    follows_field=True,
    declarable=True,
    label="shift with the table's mean temperature",
    remedy="Look at the thermal path from table to scale and at the table's clamping.",
)
THERMAL_LAG = Effect(
    name="thermal_lag",
    physics="A remote or massive part follows the seen table late, with a time constant of its own, and goes on moving after it.",
    source="first-order response of a lumped heat capacity",
    candidates=_thermal_lag,
    needs=needs_field,
    follows_field=True,
    excited_by="field",
    label="thermal lag of a remote structure",
    remedy="Wait longer before measuring, or log the temperature of the column and the bed.",
)
UNSEEN_HEAT_SOURCE = Effect(
    name="unseen_heat_source",
    physics=(
        "A source out of the camera's sight (spindle, motor, bearing) warms with the logged load and moves the reading with its "
        "own time constant."
    ),
    source="Mayr et al. 2012, CIRP Annals 61, 771",
    candidates=_unseen_heat_source,
    needs=_needs_driver,
    masked_by=unmeasured_expansion,
    excited_by="driver",
    label="unseen heat source",
    remedy=(
        "Look for the source where neither camera nor sensors reach: spindle, motor, drive, screw bearing, hydraulics; log its duty."
    ),
)
QUASI_STATIC_RESPONSE = Effect(
    name=QUASI_STATIC,
    physics="Every displacement follows the temperatures at once: the declared model of a record.",
    source="ISO 230-3",
    candidates=_quasi_static,
    declarable=True,
    label="quasi-static response to the temperatures",
    remedy="Check that the sensors sit on the parts that move the tool and the work.",
)
