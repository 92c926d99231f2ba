"""Total uncertainty of fields: parts add up, an emissivity error is a share of the rise, and simulated errors are covered."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from tests.thermography.fields.test_cycle_fields import PLAN, SURE, WHOLE, part
from tests.thermography.flir_mutations import PARAMETERS
from tests.thermography.rise_budget import temperature_rise_uncertainty
from thermography.fields.cycle_fields import assemble_fields
from thermography.fields.total_uncertainty import (
    ShownRange,
    Surface,
    compare_with_monte_carlo,
    evaluate_uncertainty,
    find_range,
)
from thermography.radiometry.planck import RadiometryError, counts_from_temperature, override, temperature_from_counts
from thermography.radiometry.uncertainty import InputUncertainty, temperature_uncertainty

CAMERA = override(PARAMETERS, emissivity=0.97, object_distance_m=1.2, reflected_temperature_K=295.15)
#: An emissivity that is far enough from 1 for first order.
WELL_KNOWN = InputUncertainty(emissivity=0.01)
NONE = InputUncertainty(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def fields(noise_K: float = 0.01, top: float = 27.0) -> xr.Dataset:
    levels = (22.0, 24.0, top)
    parts = [part(k, level, start_s=600.0 * k, noise_K=noise_K) for k, level in enumerate(levels)]
    return assemble_fields(parts, 3, PLAN, [SURE], [WHOLE])


def test_noise_and_common_part_add_up_to_the_propagated_budget():
    reduced = fields()
    before = reduced.copy(deep=True)
    done = evaluate_uncertainty(reduced, [CAMERA] * 3, WELL_KNOWN)
    xr.testing.assert_identical(reduced, before)
    cell = done.isel(y=1, x=1)
    common = temperature_uncertainty([22.0, 24.0, 27.0], CAMERA, WELL_KNOWN).common_u
    np.testing.assert_allclose(cell["temperature_u"], np.hypot(common, 0.01), rtol=2e-3)
    rise = temperature_rise_uncertainty([22.0, 24.0, 27.0], 22.0, CAMERA, WELL_KNOWN).common_u
    # The share of the rise is the derivative at its middle: exact to the third order of the rise.
    np.testing.assert_allclose(cell["temperature_rise_u"], np.hypot(rise, [0, 0.01414, 0.01414]), rtol=5e-3)
    assert done["temperature_u"].attrs["units_metadata"] == "temperature: difference"
    done = evaluate_uncertainty(fields(), [CAMERA] * 3, NONE)
    np.testing.assert_allclose(done["temperature_u"], done["temperature_noise_u"])
    np.testing.assert_allclose(done["temperature_rise_u"], done["temperature_rise_noise_u"])


def test_an_uncertain_emissivity_is_its_share_of_every_rise():
    inputs = replace(NONE, emissivity=0.0097)
    done = evaluate_uncertainty(fields(noise_K=0.0), [CAMERA] * 3, inputs)
    share = done["temperature_rise_u"] / done["temperature_rise"]
    np.testing.assert_allclose(share.values[1:], 0.01, rtol=0.05)
    np.testing.assert_allclose(done["rise_scale_u"], 0.01, rtol=0.05)
    assert float(done["temperature_rise_u"][0].max()) == 0.0


def test_a_cell_that_the_first_cycle_does_not_show_leaves_the_others_their_uncertainty():
    whole = fields()
    hidden = whole.copy(deep=True)
    hidden["temperature"][0, 2, 2] = np.nan
    for name in ("temperature_rise", "temperature_rise_noise_u"):
        hidden[name][:, 2, 2] = np.nan
    full, done = (evaluate_uncertainty(one, [CAMERA] * 3) for one in (whole, hidden))
    assert np.isfinite(done["rise_scale_u"]).all()
    np.testing.assert_allclose(done["rise_scale_u"], full["rise_scale_u"], rtol=0.01)
    assert np.isnan(done["temperature_rise_u"][:, 2, 2]).all()
    others = {"y": [0, 1], "x": [0, 1]}
    seen, expected = (each["temperature_rise_u"].isel(others) for each in (done, full))
    np.testing.assert_allclose(seen, expected, rtol=1e-3)


def test_of_a_drift_that_is_stated_and_what_a_correction_leaves_the_larger_is_in_the_rise():
    drifting = replace(NONE, camera_drift_K=0.1)
    black = override(CAMERA, emissivity=1.0, object_distance_m=0.0)
    stated = evaluate_uncertainty(fields(noise_K=0.0), [black] * 3, drifting).isel(y=1, x=1)
    np.testing.assert_allclose(stated["temperature_rise_u"], [0.0, 0.1, 0.1], rtol=1e-3)
    corrected = fields(noise_K=0.0).assign(camera_correction_u=("cycle", [0.0, 0.03, 0.04]))
    left = evaluate_uncertainty(corrected, [CAMERA] * 3, replace(NONE, camera_drift_K=0.02)).isel(y=1, x=1)
    np.testing.assert_allclose(left["temperature_rise_u"], [0.0, 0.03, 0.04], rtol=2e-3)
    # A black surface without air before it reads as warm as the camera reads it.
    for stated_K, expected in ((0.02, [0.0, 0.03, 0.04]), (0.035, [0.0, 0.035, 0.04]), (0.1, [0.0, 0.1, 0.1])):
        left = evaluate_uncertainty(corrected, [black] * 3, replace(NONE, camera_drift_K=stated_K)).isel(y=1, x=1)
        np.testing.assert_allclose(left["temperature_rise_u"], expected, rtol=2e-3)
    unexamined = fields(noise_K=0.0).assign(camera_correction_u=("cycle", [0.0, 0.0, 0.0]))
    left = evaluate_uncertainty(unexamined, [black] * 3, drifting).isel(y=1, x=1)
    np.testing.assert_allclose(left["temperature_rise_u"], [0.0, 0.1, 0.1], rtol=1e-3)


@pytest.mark.parametrize("emissivity", [0.97, 0.95, 0.90])
def test_a_change_of_what_is_reflected_is_in_the_rise_as_the_formula_gives_it(emissivity):
    camera = override(CAMERA, emissivity=emissivity)
    reflected_K, levels = camera.reflected_temperature_K, [22.0, 24.0, 27.0]
    counts = [
        counts_from_temperature(levels, override(camera, reflected_temperature_K=reflected_K + k)) for k in (-0.5, 0.5)
    ]
    per_K = np.diff([temperature_from_counts(one, camera) for one in counts], axis=0)[0]
    assert per_K[1] == pytest.approx((1.0 - emissivity) / emissivity, rel=0.05)
    assumed = evaluate_uncertainty(fields(noise_K=0.0), [camera] * 3, replace(NONE, reflected_change_K=0.5))
    np.testing.assert_allclose(assumed["temperature_rise_u"][:, 1, 1], [0.0, 0.5, 0.5] * per_K, rtol=1e-3)
    shown = fields(noise_K=0.0).assign(reflected_change_u=("cycle", [0.0, 0.3, 2.0]))
    found = evaluate_uncertainty(shown, [camera] * 3, replace(NONE, reflected_change_K=0.5))
    np.testing.assert_allclose(found["temperature_rise_u"][:, 1, 1], [0.0, 0.3, 2.0] * per_K, rtol=1e-3)
    np.testing.assert_allclose(found["rise_reflected_u"], [0.0, 0.3, 2.0] * per_K, rtol=0.04)


def test_surfaces_have_the_uncertainty_of_their_own_emissivity():
    left = np.zeros(PLAN.shape, bool)
    left[:, :3] = True
    surfaces = [Surface("", 0.97, 0.01, ~left), Surface("steel", 0.35, 0.035, left)]
    done = evaluate_uncertainty(fields(), [CAMERA] * 3, surfaces=surfaces)
    scale = done["rise_scale_u"].values
    assert scale[0, 0] == pytest.approx(0.1, rel=0.15)
    assert scale[0, 5] < 0.02


def test_metal_is_corrected_to_the_propagated_distribution_or_refused():
    metal = override(CAMERA, emissivity=0.15)
    inputs = InputUncertainty(emissivity=0.04, reflected_change_K=0.0)
    first = temperature_rise_uncertainty(27.0, 22.0, metal, inputs).common_u
    done = evaluate_uncertainty(fields(), [metal] * 3, inputs)
    assert float(done["temperature_rise_u"][2, 0, 0]) > 1.15 * float(first)
    with pytest.raises(RadiometryError, match="paint the surface"):
        evaluate_uncertainty(fields(), [metal] * 3, InputUncertainty(emissivity=0.1))


def test_drawn_inputs_are_covered(rng):
    """One wrong emissivity, one reflected temperature, one offset and scale of the camera per draw, in all cycles."""
    inputs = replace(WELL_KNOWN, reflected_change_K=0.0)
    done = evaluate_uncertainty(fields(noise_K=0.0), [CAMERA] * 3, inputs).isel(y=1, x=1)
    true = np.array([22.0, 24.0, 27.0])
    black = override(CAMERA, emissivity=1.0, object_distance_m=0.0)
    errors = []
    for _ in range(300):
        e, reflected, air, offset, scale = rng.normal(size=5)
        real = override(
            CAMERA,
            emissivity=min(0.97 + 0.01 * e, 1.0),
            reflected_temperature_K=295.15 + reflected,
            atmospheric_temperature_K=CAMERA.atmospheric_temperature_K + air,
        )
        reading = temperature_from_counts(counts_from_temperature(true, real), black)
        read = reading + 2 / 3**0.5 * offset + 0.02 / 3**0.5 * scale * reading
        errors.append(temperature_from_counts(counts_from_temperature(read, black), CAMERA) - true)
    error = np.array(errors)
    of_temperature = error / done["temperature_u"].values
    of_rise = (error[:, 1:] - error[:, :1]) / done["temperature_rise_u"].values[1:]
    # 300 draws give a standard deviation to 4 %.
    assert of_temperature.std(axis=0) == pytest.approx(1.0, abs=0.15)
    assert of_rise.std(axis=0) == pytest.approx(1.0, abs=0.15)


def shown(temperature: np.ndarray, rise: np.ndarray) -> ShownRange:
    """What cells in a row show in one cycle."""
    plan = ("cycle", "y", "x")
    fields = xr.Dataset({"temperature": (plan, temperature[None, None]), "temperature_rise": (plan, rise[None, None])})
    found = find_range(fields, np.ones((1, temperature.size), bool))
    assert found is not None
    return found


def test_first_order_is_compared_with_drawn_values_of_all_cells():
    still = np.full(4, 22.0)
    compared = compare_with_monte_carlo(shown(still, still - 22.0), CAMERA, WELL_KNOWN)
    assert compared.rise_ratio == pytest.approx(1.0, abs=0.05)
    temperature = np.array([22.0, 30.0, 40.0])
    hidden, whole = (
        compare_with_monte_carlo(shown(temperature, np.array([first, 8.0, 18.0])), CAMERA, WELL_KNOWN)
        for first in (np.nan, 0.0)
    )
    assert hidden.rise_ratio == whole.rise_ratio
    assert np.isfinite(hidden.rise_ratio)
