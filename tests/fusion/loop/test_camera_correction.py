"""Errors of the camera that the loop finds are taken out of the fields, and the model is fitted again."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from fusion.alignment.align import AxisGeometry, align
from fusion.alignment.readings import read_fused
from fusion.loop.axis import close_loop, on_corrected_fields
from fusion.loop.camera_correction import FieldFault, correct_fields, corrected_variables, find_field_errors
from fusion.twin import simulate
from fusion.twin.machine.recipe import EffectRecipe, Recipe
from fusion.twin.simulate import driver_log, environment_log
from fusion.twin.truth import deviations_of, fields_of

AXIS = AxisGeometry((500.0, 90.0), (-1.0, 0.0))
DECLARED = ["axis_expansion", "table_offset"]


@pytest.mark.parametrize(
    ("effect", "share_left"),
    [
        # A uniform jump between two frames is seen to a few mK; a patch's edge is blurred by the noise of single cells.
        (EffectRecipe("camera_offset", amplitude_K=0.5, parameters={"at_cycle": 20}), 0.05),
        (EffectRecipe("reflected_source", amplitude_K=25.0), 0.25),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_a_camera_error_is_taken_out_of_the_fields(effect: EffectRecipe, share_left: float) -> None:
    recipe = Recipe().vary(campaign={"seed": 302}, test={"cycles": 40})
    clean = fields_of(simulate(recipe))
    truth = simulate(recipe.vary(effect=(effect,)))
    fields, deviations = fields_of(truth), deviations_of(truth)
    logs = {"environment": environment_log(truth), "drivers": driver_log(truth)}
    fused = align(deviations, fields, AXIS, **logs)
    found = close_loop(read_fused(fused), DECLARED)
    assert [step.effect for step in found.steps] == [effect.name]

    errors = find_field_errors(found, fields, fused)
    right = correct_fields(fields, errors)
    wrong_K = float(np.sqrt(((fields["frame_temperature"] - clean["frame_temperature"]) ** 2).mean()))
    left_K = float(np.sqrt(((right["frame_temperature"] - clean["frame_temperature"]) ** 2).mean()))
    assert left_K < share_left * wrong_K
    variables = corrected_variables(fields, fused, errors)
    rise = variables["temperature_rise_corrected"].values - clean["temperature_rise"].values
    assert np.sqrt(np.mean(rise**2)) < share_left * wrong_K

    again = on_corrected_fields(found, read_fused(align(deviations, right, AXIS, **logs)), {effect.name})
    assert [term.effect for term in again.after.terms] == DECLARED
    assert again.rmse_final_um == pytest.approx(found.rmse_final_um, rel=0.05)
    expansion = again.declared_coefficients[0]
    assert expansion["value"] == pytest.approx(recipe.drift.expansion_ppm_per_K, abs=3 * float(expansion["u"]))


def test_nothing_is_corrected_where_the_camera_did_not_err() -> None:
    truth = simulate(Recipe().vary(campaign={"seed": 302}, test={"cycles": 20}))
    fields = fields_of(truth)
    fused = align(deviations_of(truth), fields, AXIS)
    assert find_field_errors(close_loop(read_fused(fused), DECLARED), fields, fused) == []


START = np.datetime64("2026-01-05T06:00", "ns")


def small_fused() -> xr.Dataset:
    """Three cycles of two readings, 100 s apart; the very first reading is missing."""
    time = START + np.array([[[0, 10]], [[100, 110]], [[200, 210]]]) * np.timedelta64(1, "s")
    deviation = np.zeros((3, 1, 2))
    deviation[0, 0, 0] = np.nan
    dims = ("cycle", "direction", "target")
    return xr.Dataset({"time": (dims, time), "deviation": (dims, deviation)}, coords={"cycle": [4, 5, 6]})


def small_fields(frames: int = 6) -> xr.Dataset:
    """A frame every 50 s from the first reading on, two cells, and the mean field of each cycle."""
    return xr.Dataset(
        {
            "frame_temperature": (("time", "y", "x"), np.full((frames, 1, 2), 20.0)),
            "temperature": (("cycle", "y", "x"), np.full((3, 1, 2), 20.0)),
            "temperature_rise": (("cycle", "y", "x"), np.zeros((3, 1, 2))),
        },
        coords={"time": START + 50 * np.arange(frames) * np.timedelta64(1, "s"), "cycle": [4, 5, 6]},
    )


def camera_step(value: float, u: float, *, jump: float, time_s: float) -> SimpleNamespace:
    """What the loop reports of a step of the camera's zero, as far as the correction reads it."""
    step = SimpleNamespace(
        effect="camera_offset",
        coefficients=[{"value": value, "u": u}],
        parameters={"time_s": time_s, "jump_of_the_field_K": jump},
    )
    return SimpleNamespace(steps=[SimpleNamespace(effect="dead_path"), step])


def test_a_step_of_the_zero_is_taken_out_from_its_frame_on() -> None:
    """Seconds count from the first reading that is there, at 10 s: the jump at 90 s is that of the frame at 100 s."""
    (error,) = find_field_errors(camera_step(0.5, 0.1, jump=0.6, time_s=90.0), small_fields(), small_fused())
    np.testing.assert_array_equal(error.course_K * error.pattern[0, 0], [0.0, 0.0, -0.6, -0.6, -0.6, -0.6])
    assert (error.effect, error.size_K, error.size_u_K, error.first_cycle) == ("camera_offset", 0.6, 0.1, 5)
    assert error.text == "the camera read +0.600 ± 0.200 K (k = 2) too high from cycle 5 on"
    assert error.as_json() == {
        "effect": "camera_offset",
        "text": error.text,
        "size_K": 0.6,
        "size_u_K": 0.1,
        "first_cycle": 5,
    }


@pytest.mark.parametrize(("time_s", "frame", "cycle"), [(90.0, 2, 5), (91.0, 3, 5), (141.0, 4, 6)])
def test_the_first_frame_that_is_touched_is_the_one_at_the_instant_or_after_it(
    time_s: float, frame: int, cycle: int
) -> None:
    """Frames are 50 s apart and two belong to each cycle; the first reading that is there is 10 s late."""
    (error,) = find_field_errors(camera_step(0.5, 0.1, jump=0.1, time_s=time_s), small_fields(), small_fused())
    np.testing.assert_array_equal(error.course_K * error.pattern[0, 0], np.where(np.arange(6) < frame, 0.0, -0.5))
    assert error.first_cycle == cycle
    # However small the error is, it is taken out.
    (faint,) = find_field_errors(camera_step(0.05, 0.01, jump=0.05, time_s=time_s), small_fields(), small_fused())
    assert faint.first_cycle == cycle


@pytest.mark.parametrize(("jump", "size"), [(0.79, 0.79), (0.81, 0.5), (0.21, 0.21), (0.19, 0.5)])
def test_the_size_is_that_of_the_field_where_both_agree_within_three_uncertainties(jump: float, size: float) -> None:
    (error,) = find_field_errors(camera_step(0.5, 0.1, jump=jump, time_s=90.0), small_fields(), small_fused())
    assert error.size_K == size


def test_a_step_after_the_last_frame_touches_the_last_cycle_only() -> None:
    (error,) = find_field_errors(camera_step(0.5, 0.1, jump=0.5, time_s=1e4), small_fields(), small_fused())
    assert error.first_cycle == 6 and not error.course_K.any()


def test_a_reflection_is_its_pattern_times_what_it_adds_to_its_lowest_state() -> None:
    """A patch of four cells in twenty-four that is brighter by 2 K in every other stretch of five frames, from the first on."""
    frames = 20
    lit = np.arange(frames) // 5 % 2 == 0
    temperature = np.full((frames, 4, 6), 20.0)
    temperature[lit, 1:3, 1:3] += 2.0
    fields = xr.Dataset(
        {"frame_temperature": (("time", "y", "x"), temperature)},
        coords={"time": START + 10 * np.arange(frames) * np.timedelta64(1, "s")},
    )
    step = SimpleNamespace(effect="reflected_source", coefficients=[{"value": 1.1, "u": 0.05}], parameters={})
    (error,) = find_field_errors(SimpleNamespace(steps=[step]), fields, small_fused())
    # 1.1 +- 0.05 agrees with 1, the size that the field shows.
    assert error.size_K == pytest.approx(2.0, rel=0.02) and error.size_u_K == pytest.approx(0.1, rel=0.02)
    right = temperature + error.course_K[:, None, None] * error.pattern
    np.testing.assert_allclose(right, 20.0, atol=0.05)
    assert error.text.startswith("a reflected source added up to 2.00 ± 0.20 K (k = 2) over a patch from cycle 4 on")


def field_error(*corrections: float) -> FieldFault:
    return FieldFault("camera_offset", "it erred", 0.5, 0.1, 5, np.array(corrections), np.ones((1, 2)))


def test_all_errors_are_taken_out_of_the_frames_and_the_input_stays() -> None:
    fields = small_fields()
    errors = [field_error(0.0, 0.0, -0.5, -0.5, -0.5, -0.5), field_error(0.0, 0.0, 0.0, 0.0, -0.25, -0.25)]
    right = correct_fields(fields, errors)
    np.testing.assert_array_equal(right["frame_temperature"][:, 0, 0], [20.0, 20.0, 19.5, 19.5, 19.25, 19.25])
    np.testing.assert_array_equal(fields["frame_temperature"], 20.0)


def test_a_cycle_is_corrected_by_the_mean_of_its_frames() -> None:
    """Two frames belong to each cycle; the first of the second cycle has not jumped yet."""
    errors = [field_error(-0.1, -0.1, 0.0, -0.5, -0.5, -0.5)]
    variables = corrected_variables(small_fields(), small_fused(), errors)
    correction = variables["field_correction"]
    np.testing.assert_allclose(correction.values[:, 0, 1], [-0.1, -0.1, 0.0, -0.5, -0.5, -0.5])
    np.testing.assert_allclose(variables["temperature_corrected"].values[:, 0, 0], [19.9, 19.75, 19.5])
    # The rise counts from the first cycle, corrected as well.
    np.testing.assert_allclose(variables["temperature_rise_corrected"].values[:, 0, 0], [0.0, -0.15, -0.4], atol=1e-6)
    assert correction.attrs["comment"] == "it erred" and correction.dims == ("frame_time", "plan_y", "plan_x")
    assert variables["temperature_corrected"].dims == ("cycle", "plan_y", "plan_x")


def test_a_cycle_without_a_frame_is_corrected_like_the_frame_before_it() -> None:
    fields = small_fields(4)
    variables = corrected_variables(fields, small_fused(), [field_error(0.0, 0.0, -0.5, -0.7)])
    np.testing.assert_allclose(variables["temperature_corrected"].values[:, 0, 0], [20.0, 19.4, 19.3])


def test_a_long_test_is_corrected_some_frames_at_a_time_with_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = [field_error(-0.1, -0.1, 0.0, -0.5, -0.5, -0.5), field_error(0.0, 0.0, 0.3, 0.3, 0.3, 0.0)]
    at_once = corrected_variables(small_fields(), small_fused(), errors)
    frames = correct_fields(small_fields(), errors)["frame_temperature"].values
    monkeypatch.setattr("thermography.fields.tasks.pieces.PIECE_BYTES", 40)
    monkeypatch.setattr("thermography.fields.tasks.spool.IN_MEMORY_BYTES", 8)
    for name, variable in corrected_variables(small_fields(), small_fused(), errors).items():
        assert variable.values.tobytes() == at_once[name].values.tobytes(), name
    assert correct_fields(small_fields(), errors)["frame_temperature"].values.tobytes() == frames.tobytes()
