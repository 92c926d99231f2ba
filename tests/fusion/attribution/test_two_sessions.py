"""Two campaigns of one machine: only what both show is a cause."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from fusion.attribution import two_sessions as module
from fusion.attribution.attribute import correlate
from fusion.attribution.two_sessions import SessionComparisonError, compare_sessions
from tests.fusion import field_simulator as simulator


def maps_of(made):
    return correlate(made.fused, made.field[:, ::2, ::2], draws=99, checks=1)


@pytest.fixture(scope="module")
def first():
    return maps_of(simulator.driven_session(np.random.default_rng(8), source=0))


def verdict(comparison, channel="joint"):
    return next(agreement for agreement in comparison.channels if agreement.channel == channel)


def test_a_source_that_both_sessions_show_is_a_cause(first):
    second = maps_of(simulator.driven_session(np.random.default_rng(9), source=0))
    comparison = compare_sessions(first, second)
    joint = verdict(comparison)
    assert joint.verdict == "attributable"
    assert joint.p_value <= 0.05
    assert simulator.distance_cells(joint.y_mm / 10 - 0.5, joint.x_mm / 10 - 0.5, 0) <= 7
    assert (comparison.maps["p_value"].sel(channel="joint") <= 0.05).any()


def test_each_source_is_listed_once_with_what_both_sessions_show(first):
    second = maps_of(simulator.driven_session(np.random.default_rng(9), source=0))
    sources = compare_sessions(first, second).sources
    (cause,) = [one for one in sources if one.cause]
    assert cause.shown_by == (0, 1)
    assert simulator.distance_cells(cause.y_mm / 10 - 0.5, cause.x_mm / 10 - 0.5, 0) <= 5
    assert max(cause.p_value) <= 0.05
    # 3 um per 3 K at the source, common and stretch together at the far end: 2 um/K.
    for value, u in zip(cause.sensitivity_um_per_K, cause.sensitivity_u_um_per_K, strict=True):
        assert value == pytest.approx(2.0, abs=4 * u)


def test_a_source_of_one_session_is_listed_as_its_own(first):
    second = maps_of(simulator.driven_session(np.random.default_rng(9), source=0, um_per_unit=0.0))
    alone = compare_sessions(first, second).sources
    assert {one.shown_by for one in alone} == {(0,)}
    assert min(simulator.distance_cells(one.y_mm / 10 - 0.5, one.x_mm / 10 - 0.5, 0) for one in alone) <= 5
    assert all(one.p_value[0] <= 0.05 < one.p_value[1] for one in alone)


def test_what_only_one_session_shows_is_not(first):
    second = maps_of(simulator.driven_session(np.random.default_rng(9), source=0, um_per_unit=0.0))
    comparison = compare_sessions(first, second)
    assert {agreement.verdict for agreement in comparison.channels} == {"not attributable"}
    assert verdict(comparison).reason == "no place is found by both sessions"


def test_opposite_signs_do_not_agree(first):
    second = maps_of(simulator.driven_session(np.random.default_rng(9), source=0, um_per_unit=-3.0))
    joint = verdict(compare_sessions(first, second))
    assert joint.verdict == "not attributable"
    assert joint.sensitivity_um_per_K[0] * joint.sensitivity_um_per_K[1] < 0


def test_two_warm_ups_are_not_separable():
    sessions = [maps_of(simulator.null_session("warm", np.random.default_rng(seed))) for seed in (1, 2)]
    assert {agreement.verdict for agreement in compare_sessions(*sessions).channels} == {"not separable"}


def test_other_plans_are_refused(first):
    with pytest.raises(SessionComparisonError, match="the plan grids differ along x"):
        compare_sessions(first, first.isel(x=slice(0, 5)))


def test_other_channels_are_refused(first):
    with pytest.raises(SessionComparisonError, match="share no drift channel"):
        compare_sessions(first.sel(channel=["common"]), first.sel(channel=["reversal"]))


@pytest.mark.parametrize(
    ("changed", "agrees"),
    [
        ({}, True),
        ({"sensitivity": -2.0}, False),
        ({"p_value": 0.06}, False),
        ({"sensitivity": 2.0 + 2.9 * np.hypot(0.3, 0.4)}, True),
        ({"sensitivity": 2.0 + 3.1 * np.hypot(0.3, 0.4)}, False),
        ({"x": 100.0 + 49.0}, True),
        ({"x": 100.0 + 40.0, "y": 50.0 + 40.0}, False),
    ],
)
def test_sessions_agree_with_one_place_one_sign_one_size_and_both_p_values(changed, agrees):
    """Sizes may differ by three standard uncertainties of their difference, places by 50 mm; the larger p-value counts."""
    first = {"p_value": 0.01, "sensitivity": 2.0, "sensitivity_u": 0.3, "x": 100.0, "y": 50.0}
    second = {**first, "p_value": 0.04, "sensitivity_u": 0.4, **changed}
    pair = module._Pair(*({name: np.full((1, 1), value) for name, value in one.items()} for one in (first, second)))
    assert bool(pair.agree[0, 0]) is agrees
    assert float(pair.p_value[0, 0]) == second["p_value"]


def test_small_sensitivities_of_opposite_sign_do_not_agree_though_their_sizes_do():
    """0.6 and -0.6 um/K differ by less than three standard uncertainties of 0.5 um/K."""
    common = {"p_value": 0.01, "sensitivity_u": 0.4, "x": 100.0, "y": 50.0}
    pair = module._Pair(
        *(
            {name: np.full((1, 1), value) for name, value in {**common, "sensitivity": one}.items()}
            for one in (0.6, -0.6)
        )
    )
    assert not pair.agree[0, 0]


def test_the_chance_of_the_other_session_follows_from_its_detection_limit():
    other = xr.Dataset({"threshold": 9.0, "detectable_sensitivity": (("y", "x"), [[2.0, np.nan]])})
    assert module._power(2.0, other, (0, 0)) == pytest.approx(0.8)
    assert module._power(-4.0, other, (0, 0)) > 0.999 > 0.05 > module._power(0.5, other, (0, 0))
    assert module._power(2.0, other, (0, 1)) is None


def test_a_place_on_which_both_agree_is_told_apart_from_its_neighbour():
    """One session has its mode 75 mm beside the place on which both agree: both places are listed, and the one names the other."""
    plan = xr.Dataset(coords={"y": np.arange(5.0, 200.0, 10.0), "x": np.arange(5.0, 500.0, 10.0)})
    pair = SimpleNamespace(at=lambda name, row, column: (row, column))
    alone = module._source_at(pair, "joint", (405.0, 95.0), (9, 40), (0,), True)
    agreed = module.ChannelAgreement("joint", "attributable", 330.0, 95.0, 0.004, (4.0, 5.8), (0.0, 0.0), "")
    first, second = module._tell_apart([alone], [agreed], plan, {"joint": pair})
    assert (second.x_mm, second.agrees, second.cause, second.shown_by) == (330.0, True, False, (0, 1))
    assert first.agreed_near_mm == (330.0, 95.0, 75.0) and not first.agrees
    # A cause at that place already, be it in another part of the drift, is not listed a second time.
    cause = module._source_at(pair, "common", (345.0, 95.0), (9, 34), (0, 1), True)
    assert module._tell_apart([cause], [agreed], plan, {"joint": pair}) == [cause]
