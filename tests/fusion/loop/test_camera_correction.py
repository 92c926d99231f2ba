"""Errors of the camera that the loop finds are taken out of the fields, and the model is fitted again."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.alignment.align import AxisGeometry, align
from fusion.alignment.readings import read_fused
from fusion.loop.axis import close_loop, on_corrected_fields
from fusion.loop.camera_correction import correct_fields, corrected_variables, find_field_errors
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
