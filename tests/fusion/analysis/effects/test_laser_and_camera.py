"""The laser and its compensation: index of air, material, wavelength and sensors, against their published sensitivities."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.analysis.alignment.readings import Readings, Series
from fusion.analysis.effects.laser_and_camera import (
    air_index,
    camera_offset,
    dead_path,
    laser_warm_up,
    material_compensation,
    reflected_source,
    sensor_fault,
)
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
    (dead,) = dead_path.candidates(readings, {}, None)
    # The same at all positions: 1 mm of dead path and 1 ppm are 1e-3 um.
    np.testing.assert_allclose(dead.columns[:, 0], ppm * 1e-3 * share, rtol=5e-3, atol=1e-9)
    (air,) = air_index.candidates(readings, {}, None)
    np.testing.assert_allclose(air.columns[:, 0], dead.columns[:, 0] * readings.position_mm, rtol=1e-12)
    assert (dead.units, air.units) == (("mm",), ("1",))
    assert dead.columns[0, 0] == 0.0


def test_the_material_probe_stretches_the_axis():
    readings = in_air()
    (candidate,) = material_compensation.candidates(readings, {}, None)
    rise = 3.0 * readings.seconds / (59 * 30.0)
    np.testing.assert_allclose(candidate.columns[:, 0], rise * readings.position_mm * 1e-3, atol=1e-12)
    assert candidate.units == ("ppm/K",)


def test_a_laser_that_settles_stretches_and_shifts_by_its_dead_path():
    readings = campaign()
    candidates = list(laser_warm_up.candidates(readings, {}, None))
    assert [c.parameters["time_constant_min"] for c in candidates[::2]] == [3.0, 6.0, 12.0, 24.0]
    linear, both = candidates[2:4]
    settling = np.exp(-readings.seconds / 360.0)
    np.testing.assert_allclose(linear.columns[:, 0], settling * readings.position_mm * 1e-3)
    np.testing.assert_allclose(both.columns, np.column_stack([linear.columns, settling]))
    assert (linear.units, both.units) == (("ppm",), ("ppm", "um"))
    # A shift that dies away is no evidence for the laser.
    assert (linear.beside, both.beside) == (0, 1)
    assert (linear.parameters["shape"], both.parameters["shape"]) == ("linear", "linear with dead path")


def test_a_sensor_that_jumps_is_a_step_along_the_axis():
    values = 0.1 * (-1.0) ** np.arange(41)
    values[21:] -= 20.0
    readings = campaign(series={"air_temperature": logged(values, "degC")})
    (candidate,) = sensor_fault.candidates(readings, {}, None)
    # Between the samples at 600 and 630 s: from halfway on.
    late = readings.seconds >= 615.0
    np.testing.assert_allclose(candidate.columns[:, 0], late * readings.position_mm * 1e-3)
    assert candidate.event_s == 630.0 and candidate.units == ("ppm",)
    assert candidate.parameters == {"sensor": "air_temperature", "time_s": 630.0, "jump": pytest.approx(-20.4)}


def test_a_sensor_that_sticks_is_a_ramp_along_the_axis():
    readings = campaign(series={"air_pressure": logged(np.minimum(np.arange(60.0), 20.0), "hPa")})
    (candidate,) = sensor_fault.candidates(readings, {}, None)
    hours = np.maximum(readings.seconds - 600.0, 0.0) / 3600.0
    np.testing.assert_allclose(candidate.columns[:, 0], hours * readings.position_mm * 1e-3)
    assert candidate.event_s == 600.0 and candidate.units == ("ppm/h",)
    assert candidate.parameters == {"sensor": "air_pressure", "time_s": 600.0, "jump": 0.0}


def test_what_is_missing_is_said():
    empty, air = campaign(), in_air()
    for effect in (dead_path, air_index):
        assert effect.needs(air) is None
        assert effect.needs(empty) == ("the environment log has no air_temperature, air_pressure, relative_humidity")
    dry = campaign(series={name: air.series[name] for name in ("air_temperature", "air_pressure")})
    assert dead_path.needs(dry) == "the environment log has no relative_humidity"
    assert material_compensation.needs(air) is None
    assert material_compensation.needs(empty) == "the environment log has no material_temperature"
    assert laser_warm_up.needs(empty) is None
    assert sensor_fault.needs(air) == "no logged sensor jumps or sticks"
    stuck = campaign(series={"air_pressure": logged(np.minimum(np.arange(60.0), 20.0), "hPa")})
    assert sensor_fault.needs(stuck) is None


# Errors of the camera: what a false field makes the model predict, with the sign and the weight of the declared effects.


DECLARED = {"table_offset": 2.0, "axis_expansion": 10.0}


def jumped() -> Readings:
    """The mean of the field jumps by about -20 K between the frames at 600 and 630 s."""
    values = 0.1 * (-1.0) ** np.arange(60)
    values[21:] -= 20.0
    return campaign(series={"mean_rise": logged(values, "K")})


def test_a_false_rise_makes_the_model_predict_too_much():
    readings = jumped()
    (candidate,) = camera_offset.candidates(readings, DECLARED, None)
    # 1 K too much: 2 um everywhere and 10 ppm of the length. The readings did not move, so that the model errs by the opposite.
    expected = -(2.0 + 10.0 * readings.position_mm * 1e-3)
    late = readings.seconds >= 630.0
    np.testing.assert_allclose(candidate.columns[late, 0], expected[late])
    np.testing.assert_array_equal(candidate.columns[readings.seconds <= 600.0], 0.0)
    # Between two frames the field is a straight line.
    between = readings.seconds == 610.0
    np.testing.assert_allclose(candidate.columns[between, 0], expected[between] / 3.0)
    assert candidate.units == ("K",) and candidate.event_s == 630.0
    assert candidate.parameters == {"time_s": 630.0, "jump_of_the_field_K": pytest.approx(-20.4)}


def test_without_a_declared_effect_a_false_field_does_no_harm():
    (candidate,) = camera_offset.candidates(jumped(), {}, None)
    np.testing.assert_array_equal(candidate.columns, 0.0)
    (expansion_only,) = camera_offset.candidates(jumped(), {"axis_expansion": 10.0}, None)
    assert expansion_only.columns[-1, 0] == pytest.approx(-10.0 * 100.0 * 1e-3)


def test_a_reflecting_patch_is_weighed_by_what_the_model_makes_of_it():
    seconds = 30.0 * np.arange(60)
    patch = (np.arange(60) // 10 % 2).astype(float)
    integral = patch[:, None] * np.array([0.0, 50.0, 100.0, 100.0])
    series = {"patch_mean_rise": Series(seconds, patch, "K"), "patch_axis_integral": Series(seconds, integral, "K mm")}
    readings = campaign(series=series)
    (candidate,) = reflected_source.candidates(readings, DECLARED, None)
    on_line = np.array([0.0, 50.0, 100.0, 100.0])[readings.target - 1]
    state = np.interp(readings.seconds, seconds, patch)
    np.testing.assert_allclose(candidate.columns[:, 0], -state * (2.0 + 10.0 * on_line * 1e-3), atol=1e-12)
    assert (candidate.units, candidate.parameters, candidate.event_s) == (("1",), {}, None)


def test_what_the_camera_lacks_is_said():
    empty, quiet = campaign(), campaign(series={"mean_rise": logged(np.zeros(60), "K")})
    assert camera_offset.needs(empty) == "the campaign holds no temperature of the table"
    assert camera_offset.needs(quiet) == "no frame jumps against its neighbours"
    assert camera_offset.needs(jumped()) is None
    assert reflected_source.needs(quiet) == "no patch of the field switches faster than heat can flow"
