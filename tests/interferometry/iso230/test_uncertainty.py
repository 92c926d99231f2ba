"""Uncertainty of ISO 230-2 quantities against repeated tests and against the product rule."""

import numpy as np
import pytest

from interferometry.iso230 import CONTRIBUTIONS, Iso230Budget, evaluate_iso230
from interferometry.iso230.quantities import ONE_WAY, QUANTITIES, SCATTER_ALONE, axis_quantities, target_quantities
from tests.interferometry.iso230.made_tests import test_made

pytestmark = pytest.mark.long


def test_every_quantity_has_an_uncertainty_in_both_directions_that_repeated_tests_confirm():
    rng = np.random.default_rng(11)
    profile = np.array([[0.0, 3.0, 9.0, 20.0], [4.0, 8.0, 12.0, 26.0]])
    tests = [
        evaluate_iso230(test_made(profile + rng.normal(0, 0.5, (20, 2, 4))), budget=SCATTER_ALONE) for _ in range(60)
    ]
    s = np.full(profile.shape, 0.5)
    both, reversal, repeatability = target_quantities(profile, s)
    true = axis_quantities(profile, s) | {
        "mean_unidirectional": profile,
        "standard_deviation": s,
        "repeatability": 4 * s,
        "mean_bidirectional": both,
        "reversal": reversal,
        "repeatability_bidirectional": repeatability,
        "mean_reversal": reversal.mean(),
    }
    assert set(true) == {str(name) for name in tests[0].data_vars if f"{name}_u" in tests[0]}
    for name, value in true.items():
        error = np.sqrt(np.mean([(one[name].values - value) ** 2 for one in tests], axis=0))
        stated = np.mean([one[f"{name}_u"].values for one in tests], axis=0)
        assert tests[0][f"{name}_u"].dims == tests[0][name].dims
        # 60 tests know an error to 9 %, and the largest of many such ratios lies three of them off. A takes the largest of positions that
        # scatter alike: that scatters less than each.
        assert (stated > 0.75 * error).all(), name
        assert (stated < (1.6 if name[0] == "A" else 1.35) * error).all(), name


def test_a_drift_that_both_approaches_share_leaves_the_reversal_error_its_uncertainty():
    """2 um an hour for 25 min: both passes are 2.5 min apart on average, by which the drift falsifies the reversal error."""
    rng = np.random.default_rng(12)
    seconds = 300.0 * np.arange(5)[:, None, None] + np.stack([15.0 * np.arange(10), 15.0 * (19 - np.arange(10))])
    drift = 2.0 * seconds / 3600.0
    test = test_made(rng.normal(0.0, 0.1, drift.shape) + drift)
    course = test["deviation"].copy(data=drift)
    still, moved = (evaluate_iso230(test.assign(deviation=test["deviation"] - one)) for one in (course, 0.0))
    found = evaluate_iso230(test, budget=SCATTER_ALONE, drift=course)
    falsified = abs(float(moved["mean_reversal"] - still["mean_reversal"]))
    assert falsified == pytest.approx(2.0 * 150.0 / 3600.0)
    row = found["contribution"].sel(contributor="environmental_variation")
    assert float(row.sel(quantity="mean_reversal")) == pytest.approx(falsified)
    # A variation of 0.28 um that were independent in both approaches would be 0.28 sqrt(2 / 5).
    assert float(found["environmental_variation"]) == pytest.approx(0.26, abs=0.01)
    assert float(found["B_u"]) < 0.15
    shifted = evaluate_iso230(test, budget=SCATTER_ALONE, drift=course + 100.0 * course["target"])
    # The thermal state of the window is that of its profile. Squares cancel to 1e-14 um2.
    np.testing.assert_allclose(shifted["contribution"], found["contribution"], rtol=1e-6, atol=1e-6)


def test_one_direction_has_its_own_uncertainties(rng):
    x = rng.normal(0, 1, (5, 2, 4))
    x[:, 1] = np.nan
    result = evaluate_iso230(test_made(x))
    for name in ("R_unidirectional_u", "E_unidirectional_u", "A_unidirectional_u"):
        assert np.isfinite(result[name].values).tolist() == [True, False]
    assert np.isfinite(result["mean_unidirectional_u"].values).tolist() == [[True] * 4, [False] * 4]
    assert np.isnan([float(result[f"{name}_u"]) for name in ("B", "mean_reversal", "R", "E", "M", "A")]).all()


def test_scale_errors_enter_over_the_distance_as_the_product_rule_says():
    x = np.array([[[0.0, 1.0, 5.0], [0.5, 1.5, 5.5]]]) + np.array([[[-0.01]], [[0.01]]])
    shares = evaluate_iso230(test_made(x), budget=Iso230Budget(device_ppm=10.0))["contribution"]
    # E is decided by targets 1 and 3, 20 mm apart: 10 ppm of 20 mm.
    assert float(shares.sel(quantity="E", contributor="device")) == pytest.approx(0.2)
    assert float(shares.sel(quantity="B", contributor="device")) == 0.0
    x = np.array([[[0.0, 5.0], [0.5, 5.5]]]) + np.array([[[-0.01]], [[0.01]]])
    budget = Iso230Budget(
        device_ppm=0.0,
        material_temperature_K=0.5,
        expansion_coefficient_ppm_per_K=2.0,
        difference_from_20_degC_K=4.0,
        nominal_expansion_ppm_per_K=11.7,
    )
    shares = evaluate_iso230(test_made(x), budget=budget)["contribution"].sel(quantity="M")
    assert float(shares.sel(contributor="material_temperature")) == pytest.approx(11.7 * 0.5 * 0.01)
    assert float(shares.sel(contributor="expansion_coefficient")) == pytest.approx(2.0 * 4.0 * 0.01)


def test_what_distorts_the_axis_widens_a_range_whose_extremes_lie_at_one_target():
    readings = np.tile([0.0, 0.1, 0.2, 0.3], (5, 2, 1))
    readings[:, 0, 1] += [-3.0, 3.0, 0.0, 3.0, -3.0]
    found = evaluate_iso230(test_made(readings), budget=Iso230Budget(device_ppm=10.0))
    shares = found["contribution"].sel(contributor="device")
    assert float(found["A"]) == pytest.approx(4.0 * 3.0 * np.sqrt(36.0 / 9.0 / 4.0), rel=0.01)
    assert float(shares.sel(quantity="A")) == pytest.approx(float(shares.sel(quantity="E"))) != 0.0


def test_contributions_add_up_to_the_uncertainty():
    rng = np.random.default_rng(3)
    result = evaluate_iso230(
        test_made(rng.normal(0, 1, (5, 2, 6))), budget=Iso230Budget(environmental_variation_um=0.4)
    )
    assert result["contributor"].values.tolist() == list(CONTRIBUTIONS)
    for name in result["quantity"].values:
        total = np.sqrt((result["contribution"].sel(quantity=name) ** 2).sum())
        assert float(total) == pytest.approx(float(result[f"{name}_u"]), rel=1e-12)


def test_an_environmental_variation_explains_no_more_of_s_than_there_is():
    rng = np.random.default_rng(4)
    test = test_made(rng.normal(0, 0.5, (5, 2, 6)))
    shares = evaluate_iso230(test, budget=Iso230Budget(environmental_variation_um=100.0))["contribution"]
    s = evaluate_iso230(test)["standard_deviation"].values
    within = float(shares.sel(quantity="R", contributor="environmental_variation"))
    # The whole of both standard deviations of the deciding position, and the reversal error between its means.
    assert within <= np.hypot(2 * np.sqrt((s**2).sum(axis=0).max()) * 2, 100.0 * np.sqrt(2 / 5))


def test_a_negative_uncertainty_is_refused_and_a_temperature_below_20_degC_is_none():
    with pytest.raises(ValueError, match="device_ppm=-1: give a finite number, 0 or more"):
        Iso230Budget(device_ppm=-1)
    with pytest.raises(ValueError, match=r"environmental_variation_um=-0\.1: give a finite number, 0 or more"):
        Iso230Budget(environmental_variation_um=-0.1)
    assert Iso230Budget(difference_from_20_degC_K=-2.0).difference_from_20_degC_K == -2.0


def test_a_test_worked_by_hand():
    mean, s = np.array([[0.0, 4.0, 6.0], [1.0, 2.0, 3.0]]), np.array([[0.5, 0.25, 0.5], [0.25, 0.25, 1.0]])
    both, reversal, repeatability = target_quantities(mean, s)
    assert both.tolist() == [0.5, 3.0, 4.5]
    assert reversal.tolist() == [-1.0, 2.0, 3.0]
    # 2 (0.5 + 0.25) + 1, 2 (0.25 + 0.25) + 2, 2 (0.5 + 1) + 3; four times either s is less.
    assert repeatability.tolist() == [2.5, 3.0, 6.0]
    found = axis_quantities(mean, s)
    axis = {name: float(found[name]) for name in "BREMA"}
    assert axis == {"B": 3.0, "R": 6.0, "E": 6.0, "M": 4.0, "A": 8.0}
    assert found["R_unidirectional"].tolist() == [2.0, 4.0]
    assert found["E_unidirectional"].tolist() == [6.0, 2.0]
    # (6 + 1) - (0 - 1), (3 + 2) - (1 - 0.5) against 3 - 2 = 1 at the last position.
    assert found["A_unidirectional"].tolist() == [8.0, 4.5]


@pytest.mark.parametrize("gaps", [False, True])
def test_uncertainties_do_not_depend_on_the_order_of_the_targets_or_the_end_of_the_axis(rng, gaps):
    x = rng.normal(0.0, 0.5, (5, 2, 7)) + np.linspace(0.0, 2.0, 7)
    if gaps:
        x[2, 0, 1] = x[:, 1, 4] = np.nan
    test, order = test_made(x), rng.permutation(7)
    found = evaluate_iso230(test)
    listed = test.isel(target=order).assign_coords(target=test["target"].values)
    mirrored = test_made(-x[:, ::-1, ::-1])
    for other, side in ((evaluate_iso230(listed), slice(None)), (evaluate_iso230(mirrored), slice(None, None, -1))):
        for name in QUANTITIES:
            for one in (name, f"{name}_u"):
                assert float(other[one]) == pytest.approx(float(found[one]), rel=1e-9)
        for name in ONE_WAY:
            np.testing.assert_allclose(other[f"{name}_u"][side], found[f"{name}_u"], rtol=1e-9)


def test_many_tests_at_once_are_each_by_itself():
    rng = np.random.default_rng(2)
    mean, s = rng.normal(0, 5, (7, 2, 6)), rng.uniform(0.1, 1, (7, 2, 6))
    together = axis_quantities(mean, s)
    for k in range(7):
        for name, value in axis_quantities(mean[k], s[k]).items():
            assert together[name][k] == pytest.approx(value)
