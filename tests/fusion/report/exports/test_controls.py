"""The profile as a compensation: what the control does brings it to zero, its uncertainty, and what a repeated test would show."""

import re
from collections.abc import Callable

import numpy as np
import pytest

from fusion.analysis.predicted_test import scatter_and_drift
from fusion.report.exports.controls import (
    CONTROLS,
    ErrorTable,
    ExportError,
    Origin,
    Profile,
    ThermalState,
    fit_temperature_line,
    path_variance,
    read_active,
    read_profile,
    read_twincat,
    siemens_temperature,
    tabulate,
    twincat,
)
from fusion.report.exports.export import predict, predict_test, remainder_um
from fusion.results.store import group, read_dataset, read_grouped
from tests.fusion.report.exports.small_run import (
    SHIFT_UM_PER_K,
    STRETCH_PPM_PER_K,
    UNEVEN_MM,
    material_degC,
    true_profile_um,
)

#: Position (mm), and what the axis does wrong (um) by the positive and by the negative approach; written with 1 nm resolution, of
#: TwinCAT with 0.1 um.
POSITION = np.array([-20.0, 0.0, 31.0, 60.0, 85.0])
ERROR = np.array([[2.0, 0.5, -1.25, 3.0, 6.5], [1.0, -0.75, -2.0, 2.25, 5.25]])
ROUNDING_UM = {"twincat": 0.11}
PROFILE = Profile(POSITION, ERROR, np.zeros((2, 5, 2, 5)))
#: Returns the correction (um) that a control adds to the position at (approach, position).
Corrector = Callable[[int, np.ndarray], np.ndarray]


def linuxcnc_corrects(text: str) -> Corrector:
    """The loader takes nominal minus real of each triplet and adds it to the command."""
    rows = np.array([[float(word) for word in line.split()] for line in text.splitlines()])
    return lambda approach, at: 1e3 * np.interp(at, rows[:, 0], rows[:, 0] - rows[:, 1 + approach])


def siemens_corrects(text: str) -> Corrector:
    """A positive value moves the axis in negative direction; backlash: the encoder leads by it, half of it either way."""
    assert text.startswith("%_N_AX_EEC_INI\n") and text.endswith("M17\n")
    number = {name: float(value) for name, value in re.findall(r"^\$AA_ENC_COMP_(\w+)\[0,X1\]=(\S+)$", text, re.M)}
    values = [float(value) for value in re.findall(r"^\$AA_ENC_COMP\[0,\d+,X1\]=(\S+)$", text, re.M)]
    points = number["MIN"] + number["STEP"] * np.arange(len(values))
    assert points[-1] == pytest.approx(number["MAX"]) and number["IS_MODULO"] == 0
    (backlash,) = re.findall(r"MD32450 \$MA_BACKLASH: (\S+) mm", text)
    push = 1e3 * float(backlash) / 2
    return lambda approach, at: -1e3 * np.interp(at, points, values) + (push if approach == 0 else -push)


def heidenhain_corrects(text: str) -> Corrector:
    """The measured deviation is taken off: the column of the axis forwards, BACKLASH backwards."""
    head, names, *rows, end = text.splitlines()
    assert (head, names.split(), end) == ("BEGIN AXIS_X1.COM MM", ["NR", "AXISPOS", "BACKLASH", "X1"], "[END]")
    table = np.array([[float(word) for word in row.split()] for row in rows])
    np.testing.assert_array_equal(table[:, 0], np.arange(len(rows)))
    return lambda approach, at: -1e3 * np.interp(at, table[:, 1], table[:, 3 - approach])


def twincat_corrects(text: str) -> Corrector:
    """A value is actual minus set position in 0.1 um, and is taken off: pos forwards, neg backwards."""
    rows = dict(line.split() for line in text.splitlines())
    assert rows["kw.ssfk.unit"] == rows["kw.ssfk.bilateral"] == "1" and rows["kw.ssfk.interval"] == "0"
    assert rows["kw.ssfk.kw_startpos"] == rows["kw.ssfk.table[0].setpoint"]
    points = range(int(rows["kw.ssfk.kw_nr_max"]))
    at, *both = ([0.1 * int(rows[f"kw.ssfk.table[{k}].{name}"]) for k in points] for name in ("setpoint", "pos", "neg"))
    return lambda approach, asked: -np.interp(1e3 * asked, at, both[approach])


READERS = {
    "twincat": twincat_corrects,
    "linuxcnc": linuxcnc_corrects,
    "siemens840d": siemens_corrects,
    "heidenhain": heidenhain_corrects,
}


def test_every_control_has_a_reader():
    assert set(READERS) == set(CONTROLS)


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize(("spacing", "reference"), [(None, None), (10.0, None), (15.0, 31.0)])
def test_the_control_leaves_what_is_predicted(name, spacing, reference):
    control, rounding = CONTROLS[name], ROUNDING_UM.get(name, 2e-3)
    if control.equal_spacing and spacing is None:
        pytest.skip("this control needs equally spaced points")
    table = tabulate(PROFILE, spacing_mm=spacing, reference_mm=reference)
    correct = READERS[name](control.write(table, "X1", ["a header"] if control.comment else []))
    left = ERROR + np.array([correct(approach, POSITION) for approach in range(2)])
    predicted = np.ptp(remainder_um(PROFILE, table, one_table=control.one_table))
    assert np.ptp(left) == pytest.approx(predicted, abs=rounding)
    assert np.ptp(left) < np.ptp(ERROR) / 2
    if spacing is None:
        assert np.ptp(left) < rounding
    at_reference = correct(0, np.array([table.reference_mm]))[0]
    assert at_reference == pytest.approx(0.0, abs=rounding if not control.one_table else 0.6)


def test_values_of_twincat_are_those_of_its_makers_example():
    """Set 19866.7 um, reached 19856.5 um forwards and 19874.7 um backwards: -102 and 80."""
    position = np.array([0.0, 19.8667, 40.0])
    error = np.array([[0.0, 19856.5 - 19866.7, 0.0], [0.0, 19874.7 - 19866.7, 0.0]])
    table = tabulate(Profile(position, error, np.zeros((2, 3, 2, 3))))
    rows = twincat(table, "Y", ()).splitlines()
    assert {"kw.ssfk.table[1].setpoint 198667", "kw.ssfk.table[1].pos -102", "kw.ssfk.table[1].neg 80"} <= set(rows)
    at, deviation = read_twincat(
        "kw.ssfk.unit 1\nkw.ssfk.interval 100000\nkw.ssfk.kw_nr_max 2\nkw.ssfk.table[1].pos 7\n"
    )
    np.testing.assert_allclose(at, [0.0, 10.0])
    np.testing.assert_allclose(deviation, [[0.0, 7e-4], [0.0, 7e-4]])


def origin_of(active: str, campaign_file: str = "") -> Origin:
    state = ThermalState(None, None, (1, 5), {})
    return Origin("X axis", "", "X", active, "complete", state, "0" * 64, campaign_file)


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("spacing", [None, 15.0])
def test_what_was_measured_under_a_table_is_added_to_it(tmp_path, name, spacing):
    """The axis errs by ERROR; a table of other points and range takes out something else; the sum brings it to zero."""
    control, old, rounding = CONTROLS[name], np.arange(-35.0, 101.0, 15.0), ROUNDING_UM.get(name, 2e-3)
    taken = np.array([np.sin(old / 17.0) + old / 40.0, np.sin(old / 17.0) + old / 40.0])
    if not control.one_table:
        taken[1] -= 0.4 * np.cos(old / 30.0)
    if control.equal_spacing and spacing is None:
        pytest.skip("this control needs equally spaced points")
    before = ErrorTable(old, taken, np.zeros((2, old.size)), 0.0, 15.0)
    (tmp_path / "old.txt").write_text(control.write(before, "X1", []), encoding="ascii")
    active, unknown = read_active(tmp_path, control, origin_of("old table"), str(tmp_path / "old.txt"))
    assert unknown == []
    np.testing.assert_allclose(np.diff(active.at(old)), np.diff(taken), atol=2 * rounding)
    correct_before = READERS[name](control.write(before, "X1", []))
    measured = ERROR + np.array([correct_before(approach, POSITION) for approach in range(2)])
    if control.one_table:  # the backlash of the old table is not in the file
        measured = ERROR + np.array([correct_before(0, POSITION)] * 2)
    profile = Profile(POSITION, measured, np.zeros((2, 5, 2, 5)))
    table = tabulate(profile, spacing_mm=spacing, active=active)
    correct = READERS[name](control.write(table, "X1", []))
    left = ERROR + np.array([correct(approach, POSITION) for approach in range(2)])
    predicted = np.ptp(remainder_um(profile, table, one_table=control.one_table))
    assert np.ptp(left) == pytest.approx(predicted, abs=2 * rounding)
    if spacing is None:
        # Every point of the old table is kept, also beyond the targets, where what the ends show is held.
        assert np.ptp(left) < 2 * rounding and set(old) < set(table.position_mm)
        beyond = correct(0, np.array([100.0])) - correct_before(0, np.array([100.0]))
        assert beyond == pytest.approx(correct(0, POSITION[-1:]) - correct_before(0, POSITION[-1:]), abs=rounding)


def test_a_table_that_may_have_been_active_is_asked_for(tmp_path):
    control = CONTROLS["linuxcnc"]
    for active, given in (("none", None), ("COMP_FILE x.comp", "none"), ("", " None ")):
        assert read_active(tmp_path, control, origin_of(active), given) == (None, [])
    for active, said in (("", "the campaign does not say it"), ("old one", 'machine_compensation is "old one"')):
        none, (unknown,) = read_active(tmp_path, control, origin_of(active, "../c.toml"), None)
        assert none is None and said in unknown and "--active FILE" in unknown
    (tmp_path / "r").mkdir()
    (tmp_path / "x.comp").write_text("0 0.001 0.002\n10 10.003 10.001\n[comment]\n20 99 99\n")
    found, unknown = read_active(tmp_path / "r", control, origin_of("x.comp", "../c.toml"), None)
    assert unknown == [] and found.name == "x.comp"
    np.testing.assert_allclose(found.at(np.array([0.0, 5.0, 15.0])), [[1.0, 2.0, 3.0], [2.0, 1.5, 1.0]])
    with pytest.raises(ExportError, match=r"there is no file y.comp; name the table"):
        read_active(tmp_path, control, origin_of("none"), "y.comp")
    for text, why in (
        ("a", "no three numbers"),
        ("0 0.1 0.1\n90 0.2 0.2", "COMP_FILE_TYPE 1"),
        ("1 1 1", "two points"),
    ):
        (tmp_path / "bad").write_text(text)
        with pytest.raises(ExportError, match=f"bad: is no table of LinuxCNC.*{why}"):
            read_active(tmp_path, control, origin_of("none"), str(tmp_path / "bad"))


def profile_of(position_mm: np.ndarray, values_um: np.ndarray, u_um: float = 0.0) -> Profile:
    size = position_mm.size
    covariance = u_um**2 * np.eye(2 * size).reshape(2, size, 2, size)
    return Profile(position_mm, np.stack([values_um, values_um - 1.0]), covariance)


def test_the_profile_of_a_run_is_that_of_the_axis(small_run):
    profile = read_profile(read_grouped(small_run / "deviations.nc"))
    np.testing.assert_array_equal(profile.position_mm, UNEVEN_MM)
    expected = true_profile_um(UNEVEN_MM) - true_profile_um(UNEVEN_MM)[0]
    table = tabulate(profile)
    # Noise 0.05 um over 12 cycles, less the reference: 0.02 um; four times that.
    np.testing.assert_allclose(table.deviation_um[0], expected, atol=0.08)
    np.testing.assert_allclose(table.deviation_um[1], expected - 1.0, atol=0.08)
    assert (table.u_um < 0.1).all() and table.u_um[0, 0] == 0.0


def test_targets_in_any_order_are_sorted(small_run):
    deviations = read_grouped(small_run / "deviations.nc")
    turned = deviations.isel(target=slice(None, None, -1), other_target=slice(None, None, -1))
    expected, found = read_profile(deviations), read_profile(turned)
    np.testing.assert_array_equal(found.position_mm, expected.position_mm)
    np.testing.assert_array_equal(found.deviation_um, expected.deviation_um)
    np.testing.assert_array_equal(found.covariance_um2, expected.covariance_um2)


def test_resampling_is_linear_and_ends_at_the_last_target():
    position = np.array([0.0, 26.0, 48.0, 77.0])
    profile = profile_of(position, np.array([0.0, 2.0, 5.0, 4.0]))
    table = tabulate(profile, spacing_mm=20.0, reference_mm=40.0)
    at_zero = np.interp(40.0, table.position_mm, np.interp(table.position_mm, position, [0, 2, 5, 4]))
    # 20 mm do not divide 77 mm: four equal parts, and nothing beyond what was measured.
    np.testing.assert_allclose(table.position_mm, [0, 19.25, 38.5, 57.75, 77])
    assert table.spacing_mm() == pytest.approx(19.25) and table.resampled
    expected = np.interp(table.position_mm, position, [0, 2, 5, 4]) - at_zero
    np.testing.assert_allclose(table.deviation_um[0], expected, atol=1e-12)
    np.testing.assert_allclose(table.deviation_um[0] - table.deviation_um[1], 1.0)
    # Where the axis is referenced nothing jumps, also between two points of the table.
    between = tabulate(profile, spacing_mm=20.0, reference_mm=48.0)
    assert np.interp(48.0, between.position_mm, between.deviation_um[0]) == pytest.approx(0.0, abs=1e-12)


def test_the_uncertainty_between_targets_covers_a_wandering_profile():
    """A random walk sampled every millimetre, measured at every 25th: the errors of interpolation have the stated size."""
    rng = np.random.default_rng(20260309)
    fine = np.arange(0.0, 401.0)
    ratios = []
    for _ in range(60):
        path = np.cumsum(0.1 * rng.standard_normal(fine.size))
        coarse = np.arange(0.0, 401.0, 25.0)
        profile = profile_of(coarse, np.interp(coarse, fine, path))
        table = tabulate(profile, spacing_mm=10.0)
        between = table.u_um[0] > 0
        errors = table.deviation_um[0] - (np.interp(table.position_mm, fine, path) - path[0])
        ratios.append(np.mean((errors[between] / table.u_um[0, between]) ** 2))
    # 60 paths of some 20 independent errors each, and an estimated size: the mean is 1 within a few per cent.
    assert 0.8 < np.mean(ratios) < 1.25


def test_a_straight_profile_has_no_uncertainty_between_targets():
    position = np.array([0.0, 20.0, 45.0, 80.0])
    assert path_variance(profile_of(position, position / 10.0)) == pytest.approx(0.0, abs=1e-12)
    assert path_variance(profile_of(position[:2], position[:2])) == 0.0


def test_what_does_not_suit_is_refused(small_run):
    deviations = read_grouped(small_run / "deviations.nc")
    one_sided = deviations.assign(estimate_profile=deviations["estimate_profile"].where(deviations["target"] != 3))
    with pytest.raises(ExportError, match=r"no profile at 48 mm in one approach; a compensation table needs both"):
        read_profile(one_sided)
    single = deviations.isel(target=[0], other_target=[0])
    with pytest.raises(ExportError, match="one position only"):
        read_profile(single)
    profile = read_profile(deviations)
    with pytest.raises(ExportError, match=r"the reference 200 mm is outside the measured 0 to 175 mm"):
        tabulate(profile, reference_mm=200.0)
    for spacing in (0.0, 500.0):
        with pytest.raises(ExportError, match="write a spacing above 0 and up to 175 mm"):
            tabulate(profile, spacing_mm=spacing)
    with pytest.raises(ExportError, match=r"more than 10000 points .* write 0\.0175 mm or more"):
        tabulate(profile, spacing_mm=1e-5)


def test_a_table_at_the_targets_leaves_only_the_errors_of_measurement(small_run):
    profile = read_profile(read_grouped(small_run / "deviations.nc"))
    prediction = predict(profile, tabulate(profile), one_table=False)
    assert prediction["own_um"] < 1e-9 and prediction["resampling_um"] < 1e-9
    assert prediction["before_um"] == pytest.approx(np.ptp(profile.deviation_um))


def test_a_test_with_a_table_has_the_errors_of_the_table_and_its_own():
    """Means with variance 1 of the table and 2²/4 of four cycles; median ranges of 12 and of 6 normal values: 3.2 and 2.47."""
    profile = Profile(np.arange(6.0), np.zeros((2, 6)), np.eye(12).reshape(2, 6, 2, 6))
    still = np.zeros((8, 2, 6))
    found = predict_test(profile, tabulate(profile), np.full((2, 6), 2.0), still, cycles=4, one_table=False)
    # Monte Carlo with 400 draws: a median is known within some 3 %.
    assert found["E"].value == pytest.approx(3.2 * 2**0.5, rel=0.06)
    assert found["M"].value == pytest.approx(2.47, rel=0.08)
    assert found["B"].value == pytest.approx(2.0 * 1.6, rel=0.08)  # largest of six |normal|: 1.6
    assert predict_test(profile, tabulate(profile), np.full((2, 6), np.nan), still, cycles=4, one_table=False) == {}
    exact = Profile(np.arange(6.0), np.zeros((2, 6)), 1e-12 * np.eye(12).reshape(2, 6, 2, 6))
    many = predict_test(exact, tabulate(exact), np.full((2, 6), 2.0), still, cycles=10**6, one_table=False)
    assert many["A"].value == pytest.approx(4 * 2.0, rel=0.01)


def test_a_test_with_a_table_drifts_as_the_one_that_it_was_made_from():
    """An axis without scatter that stretches by 1 um a cycle: seven windows of two cycles, 3, 2, 1, 0, 1, 2 and 3 um from its profile."""
    profile = Profile(np.arange(6.0), np.zeros((2, 6)), np.zeros((2, 6, 2, 6)))
    stretch = (np.arange(8.0)[:, None, None] - 3.5) * np.linspace(0.0, 1.0, 6) * np.ones((2, 1))
    found = predict_test(profile, tabulate(profile), np.zeros((2, 6)), stretch, cycles=2, one_table=False)
    assert found["M"].value == pytest.approx(2.0, abs=0.01) and found["M"].u == pytest.approx(1.0, abs=0.1)
    assert found["A"].value == pytest.approx(2.0 + 2.0 * 0.5**0.5, abs=0.01)


def test_one_table_leaves_the_part_of_the_reversal_that_is_not_constant(small_run):
    profile = read_profile(read_grouped(small_run / "deviations.nc"))
    reversal = profile.deviation_um[0] - profile.deviation_um[1]
    left = remainder_um(profile, tabulate(profile), one_table=True)
    constant = left - (reversal - reversal.mean()) / 2 * np.array([[1.0], [-1.0]])
    np.testing.assert_allclose(constant, constant[0, 0], atol=1e-12)


def test_the_reversal_that_one_table_leaves_is_counted_without_the_noise_of_its_measurement():
    """Constant reversal, errors of 1 um: B of a test of many cycles is that of the errors alone, not of these and of their image in it."""
    rng, found = np.random.default_rng(4), []
    for _ in range(40):
        noise = rng.standard_normal((2, 16))
        profile = Profile(np.arange(16.0), noise + np.array([[2.0], [-2.0]]), np.eye(32).reshape(2, 16, 2, 16))
        table = tabulate(profile)
        told = predict_test(profile, table, np.full((2, 16), 1e-3), np.zeros((5, 2, 16)), cycles=5, one_table=True)
        left = np.array([[2.0], [-2.0]]) - table.added_um(profile.position_mm, one_table=True)
        found.append((told["B"].value, np.abs(left[0] - left[1]).max()))
    predicted, true = np.mean(found, axis=0)
    # What is left beside the constant, whose error is 2^0.5 / 4 um; counted twice it was 2 um and more.
    assert predicted == pytest.approx(true, abs=0.8)


def test_scatter_of_few_cycles_is_drawn_together_where_it_differs_by_chance(small_run):
    deviations = read_grouped(small_run / "deviations.nc")
    drift = group(deviations, "estimate").assign(position=deviations["position"])
    own = drift["scatter"].values
    scatter, *_ = scatter_and_drift(drift)
    assert np.ptp(scatter) < 0.5 * np.ptp(own) and np.sqrt(np.mean(scatter**2)) == pytest.approx(0.05, rel=0.15)
    far = drift["scatter"].where(drift["target"] != 3, 1.0)
    assert scatter_and_drift(drift.assign(scatter=far))[0].max() > 0.8


def line_of(folder):
    material = read_dataset(folder / "fusion.nc")["material_temperature"]
    return fit_temperature_line(read_grouped(folder / "deviations.nc"), material, reference_mm=0.0)


def test_coefficients_are_those_of_the_axis(small_run):
    line = line_of(small_run)
    # 192 readings of 0.05 um noise over 2 K rms: some 0.003 um/K and 0.03 ppm/K; four times that.
    assert line.offset_um_per_K == pytest.approx(SHIFT_UM_PER_K, abs=0.02)
    assert line.gradient_ppm_per_K == pytest.approx(STRETCH_PPM_PER_K, abs=0.15)
    assert 0 < line.offset_u_um_per_K < 0.02 and 0 < line.gradient_u_ppm_per_K < 0.15
    assert line.after_um < 0.08 < 0.4 < line.before_um
    assert line.objections() == []


def test_setting_data_bring_the_drift_to_zero(small_run):
    """The control adds ABS_VALUE + SLOPE (P - REF) to the actual value, which moves the axis back by that much."""
    line = line_of(small_run)
    text = siemens_temperature(line, "X1", ["a header"])
    numbers = {name: float(value) for name, value in re.findall(r"^\$SA_TEMP_COMP_(\w+)\[X1\]=(\S+)$", text, re.M)}
    assert numbers == {"REF_POSITION": 0.0, "ABS_VALUE": 0.0, "SLOPE": 0.0}
    states = np.array([[float(word) for word in row] for row in re.findall(r"^; +([\d.]+) +(\S+) +(\S+)$", text, re.M)])
    assert states[0, 0] <= material_degC().min() and states[-1, 0] >= material_degC().max() - 1e-9
    for degC, absolute_mm, slope in states:
        rise = degC - line.mean_degC
        error_um = rise * (SHIFT_UM_PER_K + STRETCH_PPM_PER_K * UNEVEN_MM * 1e-3)
        np.testing.assert_allclose(error_um - 1e3 * (absolute_mm + slope * UNEVEN_MM), 0.0, atol=0.1)


def test_a_temperature_that_predicts_nothing_is_an_objection(small_run):
    """Temperatures without a relation to the drift: refused in nearly every case, for the one reason or the other."""
    deviations = read_grouped(small_run / "deviations.nc")
    rng = np.random.default_rng(3)
    reasons = []
    for _ in range(100):
        noise = np.broadcast_to(rng.standard_normal(12)[:, None, None], deviations["deviation"].shape)
        line = fit_temperature_line(deviations, deviations["deviation"].copy(data=noise), reference_mm=0.0)
        reasons += line.objections()
    # Two coefficients of a level of 0.01 each, of which some fail the prediction: at most 2 in 100 expected to pass.
    assert len(reasons) >= 94
    assert {reason.split(" ")[0] for reason in reasons} == {"the", "neither"}


def test_too_few_cycles_and_a_constant_temperature_are_refused(small_run):
    deviations = read_grouped(small_run / "deviations.nc")
    material = read_dataset(small_run / "fusion.nc")["material_temperature"]
    with pytest.raises(ExportError, match="6 cycles; a temperature line needs at least 10"):
        fit_temperature_line(deviations.isel(cycle=slice(6)), material, reference_mm=0.0)
    with pytest.raises(ExportError, match="the material temperature did not change"):
        fit_temperature_line(deviations, material * 0 + 20.0, reference_mm=0.0)
