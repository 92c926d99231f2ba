"""The laser and its compensation: index of air, material, wavelength and sensors, against their published sensitivities."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.alignment.readings import Readings
from fusion.effects.effect import Candidate
from fusion.effects.laser import AIR_INDEX, DEAD_PATH, LASER_WARM_UP, MATERIAL_COMPENSATION, SENSOR_FAULT
from tests.fusion.small_campaign import campaign, logged


def in_air(*, warming_K: float = 0.0, rising_hPa: float = 0.0) -> Readings:
    """Air that changes by the given amounts over the campaign, in a straight line; 20 degC, 1013.25 hPa, 50 %."""
    share = np.linspace(0.0, 1.0, 60)
    return campaign(
        series={
            "air_temperature": logged(20.0 + warming_K * share, "degC"),
            "air_pressure": logged(1013.25 + rising_hPa * share, "hPa"),
            "relative_humidity": logged(np.full(60, 50.0), "%"),
            "material_temperature": logged(20.0 + 3.0 * share, "degC"),
        }
    )


@pytest.mark.parametrize(
    ("change", "ppm"), [({"warming_K": 1.0}, -0.955), ({"rising_hPa": 1.0}, 0.268)], ids=["kelvin", "hectopascal"]
)
def test_the_air_moves_a_reading_by_its_index(change, ppm):
    readings = in_air(**change)
    share = readings.seconds / (59 * 30.0)
    (dead,) = DEAD_PATH.candidates(readings, {}, None)
    # The same at all positions: 1 mm of dead path and 1 ppm are 1e-3 um.
    np.testing.assert_allclose(dead.columns[:, 0], ppm * 1e-3 * share, rtol=5e-3, atol=1e-9)
    (air,) = AIR_INDEX.candidates(readings, {}, None)
    np.testing.assert_allclose(air.columns[:, 0], dead.columns[:, 0] * readings.position_mm, rtol=1e-12)
    assert (dead.units, air.units) == (("mm",), ("1",))
    assert dead.columns[0, 0] == 0.0


def test_the_material_probe_stretches_the_axis():
    readings = in_air()
    (candidate,) = MATERIAL_COMPENSATION.candidates(readings, {}, None)
    rise = 3.0 * readings.seconds / (59 * 30.0)
    np.testing.assert_allclose(candidate.columns[:, 0], rise * readings.position_mm * 1e-3, atol=1e-12)
    assert candidate.units == ("ppm/K",)


def test_a_laser_that_settles_stretches_and_shifts_by_its_dead_path():
    readings = campaign()
    candidates = list(LASER_WARM_UP.candidates(readings, {}, None))
    assert [c.parameters["time_constant_min"] for c in candidates[::2]] == [3.0, 6.0, 12.0, 24.0]
    linear, both = candidates[2:4]
    settling = np.exp(-readings.seconds / 360.0)
    np.testing.assert_allclose(linear.columns[:, 0], settling * readings.position_mm * 1e-3)
    np.testing.assert_allclose(both.columns, np.column_stack([linear.columns, settling]))
    assert (linear.units, both.units) == (("ppm",), ("ppm", "um"))
    assert (linear.parameters["shape"], both.parameters["shape"]) == ("linear", "linear with dead path")


def test_a_closer_look_at_the_warm_up_reaches_to_twice_its_time():
    chosen = Candidate(np.empty((0, 1)), {"time_constant_min": 6.0, "shape": "linear"}, ("ppm",))
    near = [c.parameters["time_constant_min"] for c in LASER_WARM_UP.candidates(campaign(), {}, chosen)]
    assert (min(near), max(near)) == (pytest.approx(3.0), pytest.approx(12.0))


def test_a_sensor_that_jumps_is_a_step_along_the_axis():
    values = 0.1 * (-1.0) ** np.arange(41)
    values[21:] -= 20.0
    readings = campaign(series={"air_temperature": logged(values, "degC")})
    (candidate,) = SENSOR_FAULT.candidates(readings, {}, None)
    # Between the samples at 600 and 630 s: from halfway on.
    late = readings.seconds >= 615.0
    np.testing.assert_allclose(candidate.columns[:, 0], late * readings.position_mm * 1e-3)
    assert candidate.event_s == 630.0 and candidate.units == ("ppm",)
    assert candidate.parameters == {"sensor": "air_temperature", "time_s": 630.0, "jump": pytest.approx(-20.4)}


def test_a_jump_is_dated_halfway_between_its_samples():
    values = 0.1 * (-1.0) ** np.arange(41)
    values[21:] -= 20.0
    readings = campaign(series={"air_temperature": logged(values, "degC", step_s=40.0)})
    (candidate,) = SENSOR_FAULT.candidates(readings, {}, None)
    # 800 s to 840 s: the reading at 820 s, halfway, is behind the jump, that at 810 s is not.
    assert candidate.columns[readings.seconds == 820.0, 0] > 0.0
    assert candidate.columns[readings.seconds == 810.0, 0] == 0.0


def test_a_sensor_that_sticks_is_a_ramp_along_the_axis():
    readings = campaign(series={"air_pressure": logged(np.minimum(np.arange(60.0), 20.0), "hPa")})
    (candidate,) = SENSOR_FAULT.candidates(readings, {}, None)
    hours = np.maximum(readings.seconds - 600.0, 0.0) / 3600.0
    np.testing.assert_allclose(candidate.columns[:, 0], hours * readings.position_mm * 1e-3)
    assert candidate.event_s == 600.0 and candidate.units == ("ppm/h",)
    assert candidate.parameters == {"sensor": "air_pressure", "time_s": 600.0, "jump": 0.0}


def test_what_is_missing_is_said():
    empty, air = campaign(), in_air()
    for effect in (DEAD_PATH, AIR_INDEX):
        assert effect.needs(air) is None
        assert effect.needs(empty) == ("the environment log has no air_temperature, air_pressure, relative_humidity")
    dry = campaign(series={name: air.series[name] for name in ("air_temperature", "air_pressure")})
    assert DEAD_PATH.needs(dry) == "the environment log has no relative_humidity"
    assert MATERIAL_COMPENSATION.needs(air) is None
    assert MATERIAL_COMPENSATION.needs(empty) == "the environment log has no material_temperature"
    assert LASER_WARM_UP.needs(empty) is None
    assert SENSOR_FAULT.needs(air) == "no logged sensor jumps or sticks"
    stuck = campaign(series={"air_pressure": logged(np.minimum(np.arange(60.0), 20.0), "hPa")})
    assert SENSOR_FAULT.needs(stuck) is None
