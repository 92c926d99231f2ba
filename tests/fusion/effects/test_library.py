"""The library as a whole: names, words, and the promise of a declarable effect."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.alignment.readings import Readings, Series
from fusion.effects import library as module
from fusion.effects.effect import Effect
from fusion.effects.library import LIBRARY, describe_effect, library
from fusion.effects.thermal import QUASI_STATIC_RESPONSE
from tests.fusion.small_campaign import campaign, logged


def everything() -> Readings:
    """A campaign in which every effect of the library can be tried."""
    rng = np.random.default_rng(3)
    jump = 0.1 * (-1.0) ** np.arange(60) + np.where(np.arange(60) > 20, -20.0, 0.0)
    positions = np.array([100.0, 200.0, 300.0, 400.0, 500.0])
    series = {
        "mean_rise": logged(jump, "K"),
        "axis_integral": Series(30.0 * np.arange(60), jump[:, None] * positions, "K mm"),
        "patch_mean_rise": logged(jump, "K"),
        "patch_axis_integral": Series(30.0 * np.arange(60), jump[:, None] * positions, "K mm"),
        "duty": logged(rng.uniform(size=60), "1"),
        "air_temperature": logged(20.0 + 0.01 * jump, "degC"),
        "air_pressure": logged(1013.0 + rng.uniform(size=60), "hPa"),
        "relative_humidity": logged(np.full(60, 50.0), "%"),
        "material_temperature": logged(20.0 + rng.uniform(size=60), "degC"),
        "temperature bed": logged(rng.uniform(size=60), "K"),
    }
    return campaign(cycles=14, positions_mm=tuple(positions), series=series, drivers=("duty",))


def test_the_library_is_in_the_order_of_the_documentation():
    assert [effect.name for effect in LIBRARY] == [
        "axis_expansion",
        "table_offset",
        "thermal_lag",
        "unseen_heat_source",
        "dead_path",
        "air_index",
        "material_compensation",
        "angular_growth",
        "reversal_drift",
        "step_event",
        "periodic_disturbance",
        "pitch_error",
        "camera_offset",
        "reflected_source",
        "laser_warm_up",
        "sensor_fault",
    ]
    assert list(library()) == [effect.name for effect in LIBRARY]


@pytest.mark.parametrize("effect", [*LIBRARY, QUASI_STATIC_RESPONSE], ids=lambda effect: effect.name)
def test_every_effect_keeps_its_contract(effect):
    readings = everything()
    assert effect.label and effect.remedy and effect.physics and effect.source
    assert effect.words == effect.label != effect.name
    assert effect.excited_by == {"thermal_lag": "field", "unseen_heat_source": "driver"}.get(effect.name, "")
    assert effect.needs(readings) is None
    candidates = list(effect.candidates(readings, {"table_offset": 2.0, "axis_expansion": 10.0}, None))
    assert candidates
    for candidate in candidates:
        assert candidate.columns.shape == (readings.seconds.size, len(candidate.units))
        assert np.isfinite(candidate.columns).all()
        assert 0 <= candidate.beside < len(candidate.units)
        assert candidate.prior is None


def test_a_declarable_effect_has_one_candidate_without_a_model():
    declarable = {effect.name for effect in LIBRARY if effect.declarable}
    assert declarable == {
        "axis_expansion",
        "table_offset",
        "dead_path",
        "air_index",
        "material_compensation",
    }
    for name in declarable:
        (candidate,) = library()[name].candidates(everything(), {}, None)
        assert candidate.parameters == {} and candidate.columns.any()
    assert QUASI_STATIC_RESPONSE.declarable


def test_every_effect_with_a_parameter_is_offered_again_near_each_of_its_candidates():
    """A closer look must hold candidates, or the search could not move."""
    readings = everything()
    for effect in LIBRARY:
        for candidate in list(effect.candidates(readings, {}, None))[::7]:
            near = list(effect.candidates(readings, {}, candidate))
            assert near, effect.name
            assert all(other.parameters.keys() >= candidate.parameters.keys() - _OPTIONAL for other in near), (
                effect.name
            )


#: Parameters that not every candidate of an effect has: those of what is followed.
_OPTIONAL = {"start", "second_time_constant_min"}


def test_a_users_effect_is_added_or_replaces_one_of_the_same_name(monkeypatch):
    def none(readings, coefficients, near):
        return iter(())

    own, other = Effect("own", "", "", none), Effect("dead_path", "", "", none)
    monkeypatch.setattr(module, "plugins", lambda: {"first": own, "second": other})
    monkeypatch.setattr(module, "load_plugin", lambda plugin, point: point)
    effects = library()
    assert list(effects)[-1] == "own" and effects["dead_path"] is other
    assert describe_effect("own") is own


def test_effects_are_described_by_name_the_declared_model_of_a_record_included():
    assert describe_effect("quasi_static") is QUASI_STATIC_RESPONSE
    assert describe_effect("dead_path") is library()["dead_path"]
    assert describe_effect("sun_spots") is None
