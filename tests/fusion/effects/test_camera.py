"""Errors of the camera: what a false field makes the model predict, with the sign and the weight of the declared effects."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.alignment.readings import Readings, Series
from fusion.effects.camera import CAMERA_OFFSET, REFLECTED_SOURCE
from tests.fusion.small_campaign import campaign, logged

DECLARED = {"table_offset": 2.0, "axis_expansion": 10.0}


def jumped() -> Readings:
    """The mean of the field jumps by about -20 K between the frames at 600 and 630 s."""
    values = 0.1 * (-1.0) ** np.arange(60)
    values[21:] -= 20.0
    return campaign(series={"mean_rise": logged(values, "K")})


def test_a_false_rise_makes_the_model_predict_too_much():
    readings = jumped()
    (candidate,) = CAMERA_OFFSET.candidates(readings, DECLARED, None)
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
    (candidate,) = CAMERA_OFFSET.candidates(jumped(), {}, None)
    np.testing.assert_array_equal(candidate.columns, 0.0)
    (expansion_only,) = CAMERA_OFFSET.candidates(jumped(), {"axis_expansion": 10.0}, None)
    assert expansion_only.columns[-1, 0] == pytest.approx(-10.0 * 100.0 * 1e-3)


def test_a_reflecting_patch_is_weighed_by_what_the_model_makes_of_it():
    seconds = 30.0 * np.arange(60)
    patch = (np.arange(60) // 10 % 2).astype(float)
    integral = patch[:, None] * np.array([0.0, 50.0, 100.0, 100.0])
    series = {
        "patch_mean_rise": Series(seconds, patch, "K"),
        "patch_axis_integral": Series(seconds, integral, "K mm"),
    }
    readings = campaign(series=series)
    (candidate,) = REFLECTED_SOURCE.candidates(readings, DECLARED, None)
    on_line = np.array([0.0, 50.0, 100.0, 100.0])[readings.target - 1]
    state = np.interp(readings.seconds, seconds, patch)
    np.testing.assert_allclose(candidate.columns[:, 0], -state * (2.0 + 10.0 * on_line * 1e-3), atol=1e-12)
    assert (candidate.units, candidate.parameters, candidate.event_s) == (("1",), {}, None)


def test_what_is_missing_is_said():
    empty, quiet = campaign(), campaign(series={"mean_rise": logged(np.zeros(60), "K")})
    assert CAMERA_OFFSET.needs(empty) == "the campaign holds no temperature of the table"
    assert CAMERA_OFFSET.needs(quiet) == "no frame jumps against its neighbours"
    assert CAMERA_OFFSET.needs(jumped()) is None
    assert REFLECTED_SOURCE.needs(quiet) == "no patch of the field switches faster than heat can flow"
