"""Counts to temperature: the vendor's export, the inverse, overrides, emissivity of known states, parameters outside their range."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.thermography.flir_mutations import PARAMETERS, TIME, frame
from thermography.io.flir import read_frame
from thermography.radiometry.planck import (
    Overrides,
    ParameterLog,
    RadiometryError,
    black_body_signal,
    calibrate,
    check_parameters,
    counts_from_temperature,
    override,
    path_transmission,
    signal_slope,
    temperature_from_counts,
    transmission,
)
from thermography.radiometry.uncertainty import KnownState, estimate_emissivity


@pytest.fixture
def exported(real_file):
    """A frame of an E40bx, and the temperatures that the vendor's program makes of it, degC."""
    folder = "gpereyrairujo__IRimage/Windows/IRimage/test/"
    vendor = np.genfromtxt(real_file(folder + "csv/test_image.csv"), delimiter=",", encoding="utf-8-sig")
    return read_frame(real_file(folder + "test_image.jpg")), vendor


@pytest.mark.real_data
def test_e40bx_equals_the_vendors_export_to_half_a_printed_digit(exported):
    frame, vendor = exported
    difference = calibrate(frame.counts, frame.parameters).astype(float) - vendor
    # Half of the last printed digit, plus the resolution of the float32 kelvins on both sides (300 K: 1.5e-5 K).
    assert np.abs(difference).max() <= 0.0005 + 1.5e-5
    # Rounding errors of the print alone: uniform within +-0.0005, mean zero, mean size 0.00025.
    assert np.abs(difference).mean() == pytest.approx(0.00025, rel=0.02)
    assert abs(difference.mean()) < 2e-5
    printed = np.round(temperature_from_counts(frame.counts, frame.parameters), 3)
    assert np.mean(printed == vendor) > 0.9998


@pytest.mark.real_data
def test_sc660_sequence_stores_the_transmission_that_the_formula_gives(real_file):
    frame = read_frame(real_file("gtatters__Thermimage/inst/extdata/SampleSEQ.seq"))
    stored = frame.parameters.stored_transmission
    assert stored == pytest.approx(0.993943155, abs=1e-9)
    # float32 of the file: 3e-8.
    assert path_transmission(frame.parameters) == pytest.approx(stored, rel=1e-7)


@pytest.mark.real_data
def test_half_the_path_taken_twice_is_not_what_the_vendor_calculates(exported):
    frame, vendor = exported
    half = path_transmission(override(frame.parameters, object_distance_m=frame.parameters.object_distance_m / 2))
    assert (path_transmission(frame.parameters), half**2) == pytest.approx((0.98640, 0.98090), abs=5e-6)
    twice = override(frame.parameters, stored_transmission=half**2)
    difference = temperature_from_counts(frame.counts, twice) - vendor
    # As the method page quotes it: 0.102 K at most, positive above the temperature of the air and negative below.
    assert np.abs(difference).max() == pytest.approx(0.102, abs=0.0005)
    air_degC = frame.parameters.atmospheric_temperature_K - 273.15
    assert (difference[vendor > air_degC + 1] > 0).all() and (difference[vendor < air_degC - 1] < 0).all()


def test_formula_at_hand_calculated_points():
    """By hand, with rounded constants: S(300 K) = 21106.77 / (0.012545258 (exp(1501/300) - 1)) + 7340 = 18714.9 counts."""
    black = replace(PARAMETERS, emissivity=1.0, object_distance_m=0.0)
    expected = 21106.76953125 / (0.012545257806777954 * (np.exp(1501 / 300) - 1)) + 7340
    assert expected == pytest.approx(18714.9, abs=0.05)
    assert float(black_body_signal(300.0, black)) == pytest.approx(expected, rel=1e-12)
    assert float(temperature_from_counts(expected, black)) == pytest.approx(26.85, abs=1e-9)
    # A grey surface as warm as its surroundings looks like a black one, whatever its emissivity, distance and window.
    grey = replace(black, emissivity=0.3, object_distance_m=10.0, window_transmission=0.8)
    warm = {f"{name}_temperature_K": 300.0 for name in ("reflected", "atmospheric", "window")}
    assert float(temperature_from_counts(expected, replace(grey, **warm))) == pytest.approx(26.85, abs=1e-9)


def test_slope_is_the_derivative_of_the_signal():
    kelvin = np.array([250.0, 293.15, 400.0])
    difference = black_body_signal(kelvin + 0.01, PARAMETERS) - black_body_signal(kelvin - 0.01, PARAMETERS)
    # The second difference of a 0.02 K step leaves 1e-8 of the slope, cancellation of 18000 counts 1e-9.
    np.testing.assert_allclose(signal_slope(kelvin, PARAMETERS), difference / 0.02, rtol=1e-7)


def test_calibrate_is_the_float64_formula_within_float32():
    counts = np.arange(9000, 60000, dtype=np.uint16).reshape(-1, 100)
    before = counts.copy()
    temperature = calibrate(counts, PARAMETERS)
    np.testing.assert_array_equal(counts, before)
    assert temperature.dtype == np.float32 and temperature.shape == counts.shape
    # Relative float32 resolution of values up to 130 degC.
    np.testing.assert_allclose(temperature, temperature_from_counts(counts, PARAMETERS), rtol=1e-7, atol=1e-5)


@pytest.mark.parametrize("view", [np.s_[::2, ::3], np.s_[:, 5], np.s_[3, 4]])
def test_any_shape_and_stride_is_calibrated(view):
    counts = np.arange(18000, 18200, dtype=np.uint16).reshape(10, 20)
    np.testing.assert_array_equal(calibrate(counts[view], PARAMETERS), calibrate(counts, PARAMETERS)[view])


def test_frames_that_share_their_parameters_give_the_same_bits_in_any_order_and_by_threads():
    """A table of temperatures is shared and grows with the counts that occur; what it held before must not show."""
    rng = np.random.default_rng(5)
    edges = np.sort(rng.integers(0, 1 << 16, (60, 2)), axis=1)
    frames = [rng.integers(low, high + 1, 50).astype(np.uint16) for low, high in edges]
    frames.append(np.array([0, 65535], np.uint16))
    ours = replace(PARAMETERS, emissivity=0.876)
    alone = [temperature_from_counts(counts, ours).astype(np.float32) for counts in frames]
    with ThreadPoolExecutor(4) as executor:
        together = list(executor.map(calibrate, frames, [ours] * len(frames)))
    for shared, single in zip(together, alone, strict=True):
        assert shared.tobytes() == single.tobytes()


def test_counts_below_any_temperature_give_nan():
    # S = counts - O is negative below 7340 counts minus the offset: no temperature of any surface.
    assert np.isnan(calibrate(np.array([0, 100], np.uint16), PARAMETERS)).all()


fractions = st.floats(0.2, 1.0)
kelvins = st.floats(250.0, 350.0)


@settings(max_examples=200, deadline=None)
@given(
    temperature=st.floats(-20, 120),
    changes=st.fixed_dictionaries(
        {f"{name}_temperature_K": kelvins for name in ("reflected", "atmospheric", "window")}
        | {"emissivity": fractions, "window_transmission": fractions}
        | {"object_distance_m": st.floats(0, 20), "relative_humidity": st.floats(0, 1)}
    ),
)
def test_temperature_to_counts_and_back(temperature, changes):
    parameters = override(PARAMETERS, **changes)
    counts = counts_from_temperature(temperature, parameters)
    assert float(temperature_from_counts(counts, parameters)) == pytest.approx(temperature, abs=1e-8)


def test_an_emissivity_map_equals_one_calibration_per_region():
    counts = np.full((2, 3), 19000, np.uint16)
    emissivity = np.array([[0.95, 0.9, 0.5], [0.2, 1.0, 0.95]])
    temperature = temperature_from_counts(counts, PARAMETERS, emissivity=emissivity)
    for place, value in np.ndenumerate(emissivity):
        alone = temperature_from_counts(19000, override(PARAMETERS, emissivity=value))
        assert temperature[place] == pytest.approx(float(alone), abs=1e-12)


def test_transmission_falls_with_distance_and_humidity():
    distances = [path_transmission(override(PARAMETERS, object_distance_m=d)) for d in (0, 1, 5, 20, 100)]
    assert distances[0] == 1.0 and all(a > b for a, b in pairwise(distances))
    humidities = [path_transmission(override(PARAMETERS, relative_humidity=h)) for h in (0.1, 0.5, 0.9)]
    assert humidities[0] > humidities[1] > humidities[2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"emissivity": 0.0}, "emissivity = 0: expected a fraction above 0 and up to 1"),
        ({"emissivity": 97.0}, "emissivity = 97: expected a fraction"),
        ({"window_transmission": float("nan")}, "window_transmission = nan: expected a fraction"),
        ({"relative_humidity": 45.0}, "relative_humidity = 45: expected a fraction from 0 to 1"),
        ({"object_distance_m": -1.0}, "object_distance_m = -1: expected 0 m or more"),
        ({"reflected_temperature_K": 22.0}, "reflected_temperature_K = 22: expected kelvin between 100 and 3000"),
        ({"planck_r1": 0.0}, r"planck_r1 = 0: expected a positive number \(the file is not calibrated\)"),
        ({"atmosphere_x": float("inf")}, "atmosphere_x = inf: expected a finite number"),
    ],
)
def test_parameters_without_meaning_are_refused_by_name(change, message):
    broken = replace(PARAMETERS, **change)
    with pytest.raises(RadiometryError, match=message + ".*; override the wrong values of the file"):
        calibrate(np.full(3, 18000, np.uint16), broken)


@pytest.mark.parametrize("name", ["reflected_temperature_K", "atmospheric_temperature_K", "window_temperature_K"])
def test_temperatures_from_100_to_3000_kelvin_and_fractions_from_none_to_all_are_taken(name):
    behind_glass = replace(PARAMETERS, window_transmission=0.9, stored_transmission=0.9)
    for value in (100.0, 3000.0):
        check_parameters(replace(behind_glass, **{name: value}))
    for value in (99.9, 3000.1):
        with pytest.raises(RadiometryError, match=f"{name} = "):
            check_parameters(replace(behind_glass, **{name: value}))
    for fraction in ("relative_humidity", "stored_transmission"):
        check_parameters(replace(behind_glass, **{fraction: 0.0}))
        check_parameters(replace(behind_glass, **{fraction: 1.0}))
        for value in (-0.01, 1.01):
            with pytest.raises(RadiometryError, match=f"{fraction} = "):
                check_parameters(replace(behind_glass, **{fraction: value}))


def test_all_faults_come_in_one_message_and_a_window_that_is_not_there_has_none():
    with pytest.raises(RadiometryError, match=r"emissivity = 2.*relative_humidity = 3"):
        check_parameters(replace(PARAMETERS, emissivity=2.0, relative_humidity=3.0))
    without = replace(PARAMETERS, window_temperature_K=0.0)
    check_parameters(without)
    assert temperature_from_counts(18000, without) == temperature_from_counts(18000, PARAMETERS)
    with pytest.raises(RadiometryError, match="window_temperature_K = 0"):
        check_parameters(replace(PARAMETERS, window_temperature_K=0.0, window_transmission=0.9))


@pytest.mark.parametrize(
    "change",
    [{"atmosphere_alpha1": -1e5}, {"atmosphere_x": -3.0, "object_distance_m": 400.0}, {"atmosphere_beta2": -1e30}],
)
def test_constants_of_the_air_that_give_no_transmission_are_refused_unless_one_is_stored(change):
    broken = replace(PARAMETERS, stored_transmission=0.0, **change)
    with pytest.raises(RadiometryError, match=r"transmission of the air = .*atmosphere_alpha1 = .*expected a fraction"):
        calibrate(np.full(3, 18000, np.uint16), broken)
    calibrate(np.full(3, 18000, np.uint16), replace(broken, stored_transmission=0.97))


def test_unknown_names_averages_and_wild_emissivities_are_refused():
    with pytest.raises(RadiometryError, match="parameter 'distance' is unknown; use one of emissivity"):
        override(PARAMETERS, distance=2.0)
    with pytest.raises(RadiometryError, match="counts: expected uint16, got float64; for means use"):
        calibrate(np.array([18000.5]), PARAMETERS)
    with pytest.raises(RadiometryError, match=r"emissivity from 0 to 0\.5: expected fractions above 0 and up to 1"):
        temperature_from_counts(18000, PARAMETERS, emissivity=[0.0, 0.5])
    with pytest.raises(RadiometryError, match=r"emissivity from 0\.5 to 1\.01: expected fractions above 0 and up to 1"):
        temperature_from_counts(18000, PARAMETERS, emissivity=[0.5, 1.01])
    with pytest.raises(RadiometryError, match="counts: expected uint16, got uint8"):
        calibrate(np.array([180], np.uint8), PARAMETERS)


TIMES = TIME + np.array([0, 100, 300]).astype("timedelta64[s]")


def test_constants_and_logs_replace_what_the_file_says():
    changed = Overrides({"emissivity": 0.97, "object_distance_m": 1.2})(frame())
    assert (changed.emissivity, changed.object_distance_m) == (0.97, 1.2)
    assert changed.planck_r1 == PARAMETERS.planck_r1
    assert Overrides()(frame()) is PARAMETERS
    air = ParameterLog(TIMES, np.array([293.0, 295.0, 294.0]))
    overrides = Overrides({"atmospheric_temperature_K": 300.0, "emissivity": 0.9}, {"atmospheric_temperature_K": air})
    assert overrides(frame(seconds=0)).atmospheric_temperature_K == 293.0
    assert overrides(frame(seconds=25)).atmospheric_temperature_K == pytest.approx(293.5)
    assert overrides(frame(seconds=200)).atmospheric_temperature_K == pytest.approx(294.5)
    assert overrides(frame(seconds=300)).emissivity == 0.9
    air = ParameterLog(TIMES.astype("datetime64[ns]"), np.array([293.0, 295.0, 294.0]))
    with pytest.raises(RadiometryError, match=r"frame at 2026-03-09T06:38:48\.125: the log reaches from"):
        Overrides(logs={"atmospheric_temperature_K": air})(frame(seconds=301))
    air = ParameterLog(TIMES[:1], np.array([293.0]))
    assert air.interpolate(TIMES[0]) == 293.0
    with pytest.raises(RadiometryError, match="only; extend it"):
        air.interpolate(TIMES[1])


@pytest.mark.parametrize(
    ("times", "values", "message"),
    [
        (TIMES, [1.0, 2.0], r"expected as many times as values, got \(3,\) and \(2,\)"),
        (TIMES[::-1], [1.0, 2.0, 3.0], "expected rising times and finite values; sort it and drop gaps"),
        (TIMES, [1.0, np.nan, 3.0], "expected rising times and finite values"),
        (TIMES[[0, 1, 1]], [1.0, 2.0, 3.0], "expected rising times and finite values"),
        (TIMES[:2], [1.0, 2.0, 3.0], r"expected as many times as values, got \(2,\) and \(3,\)"),
        (TIMES[None], [[1.0, 2.0, 3.0]], r"expected as many times as values, got \(1, 3\) and \(1, 3\)"),
        (TIMES[:0], [], r"expected as many times as values, got \(0,\) and \(0,\)"),
    ],
)
def test_a_broken_log_is_refused(times, values, message):
    with pytest.raises(RadiometryError, match=message):
        ParameterLog(times, np.array(values))


@pytest.mark.parametrize(
    ("changes", "stored"),
    [
        ({"relative_humidity": 0.9}, 0.0),
        ({"object_distance_m": 5.0}, 0.0),
        ({"atmospheric_temperature_K": 310.0}, 0.0),
        ({"emissivity": 0.9}, 0.98),
        ({"relative_humidity": 0.9, "stored_transmission": 0.95}, 0.95),
    ],
)
def test_a_stored_transmission_goes_with_the_air_that_it_was_stored_for(changes, stored):
    kept = replace(PARAMETERS, stored_transmission=0.98)
    changed = override(kept, **changes)
    assert changed.stored_transmission == stored
    # Without a stored one, the transmission follows from the changed air.
    recomputed = transmission(override(replace(kept, stored_transmission=0.0), **changes))
    assert transmission(changed) == (recomputed if stored == 0.0 else stored)


def _states(emissivity: float, *, reflected_K: float = 297.0, window: float = 1.0, u: float = 0.2) -> list[KnownState]:
    parameters = override(
        PARAMETERS, emissivity=emissivity, reflected_temperature_K=reflected_K, window_transmission=window
    )
    return [KnownState(float(counts_from_temperature(t, parameters)), 2.0, t, u) for t in (22.0, 45.0)]


@pytest.mark.parametrize("emissivity", [0.3, 0.6, 0.85, 0.97])
@pytest.mark.parametrize("window", [1.0, 0.85])
def test_the_truth_comes_back_whatever_is_reflected(emissivity, window):
    parameters = override(PARAMETERS, window_transmission=window, emissivity=0.99)
    for reflected in (280.0, 297.0, 330.0):
        estimate = estimate_emissivity(*_states(emissivity, reflected_K=reflected, window=window), parameters)
        assert estimate.emissivity == pytest.approx(emissivity, abs=1e-12)


def test_its_uncertainty_covers_repeated_experiments(rng):
    exact = _states(0.85)
    u = estimate_emissivity(*exact, PARAMETERS).emissivity_u
    estimates = []
    for _ in range(1000):
        drawn = [
            KnownState(s.counts + rng.normal(0, s.counts_u), s.counts_u, s.temperature_degC + rng.normal(0, 0.2), 0.2)
            for s in exact
        ]
        estimates.append(estimate_emissivity(*drawn, PARAMETERS).emissivity)
    # A standard deviation of 1000 draws scatters by 2.2 %.
    assert np.std(estimates, ddof=1) == pytest.approx(u, rel=0.09)
    assert np.mean(estimates) == pytest.approx(0.85, abs=4 * u / np.sqrt(1000) + 1e-3)


def test_what_determines_nothing_is_told_and_refused():
    assert estimate_emissivity(*_states(0.95), PARAMETERS).is_determined
    assert not estimate_emissivity(*_states(0.9, u=3.0), PARAMETERS).is_determined
    cold, hot = _states(0.95)
    impossible = KnownState(2 * hot.counts, 2.0, hot.temperature_degC, 0.2)
    assert not estimate_emissivity(cold, impossible, PARAMETERS).is_determined
    state = _states(0.9)[0]
    with pytest.raises(RadiometryError, match="both states have 22 degC: heat it between them"):
        estimate_emissivity(state, state, PARAMETERS)
