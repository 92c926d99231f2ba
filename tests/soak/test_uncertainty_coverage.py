"""Stated uncertainty of coefficients and temperatures against their errors and independent draws."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from multiprocessing import get_context

import numpy as np
import pytest
from scipy import stats

from fusion.analysis.alignment.align import AxisGeometry, align
from fusion.analysis.alignment.readings import read_fused
from fusion.analysis.drift_model.axis import average_over_drifts, coefficients_of, declare
from fusion.analysis.drift_model.closed_loop import close_loop
from fusion.analysis.drift_model.model import fit_model
from fusion.analysis.effects.library import library
from fusion.twin import simulate
from fusion.twin.instruments import deviations_of, fields_of
from fusion.twin.recipe import Recipe
from fusion.twin.simulate import driver_log, environment_log
from tests.fusion.loop_bench import DECLARED, effect_of, readings_of
from tests.soak.rates import campaigns, first_seed, rate, wilson
from tests.thermography.flir_mutations import PARAMETERS
from tests.thermography.rise_budget import temperature_rise_uncertainty
from thermography.radiometry.planck import counts_from_temperature, override, temperature_from_counts
from thermography.radiometry.uncertainty import (
    InputUncertainty,
    monte_carlo_ratio,
    temperature_uncertainty,
)

pytestmark = pytest.mark.slow

SMOOTH_UM = 0.6
DRIFTS = {
    "no smooth drift": lambda time_s, phase: np.zeros_like(time_s),
    "settling like sqrt(t)": lambda time_s, phase: np.sqrt(time_s),
    "rhythm of a day": lambda time_s, phase: np.sin(2.0 * np.pi * (time_s / 86400.0 + phase)),
}


@pytest.mark.parametrize("drift", list(DRIFTS))
def test_coefficients_beside_a_smooth_drift_are_covered(drift: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A random walk as usual, and 0.6 um rms of a smooth drift: common, a stretch, or both, in turn; constant and random loads in turn."""
    runs, first = campaigns(20), first_seed(500)
    errors = {name: np.empty((2, 2, runs)) for name in ("axis_expansion", "table_offset")}
    for number, seed in enumerate(range(first, first + runs)):
        recipe = Recipe().vary(campaign={"seed": seed}, duty={"kind": ("constant", "random")[number % 2]})
        truth = simulate(recipe)
        axis = AxisGeometry((500.0, 90.0), (-1.0, 0.0))
        logs = {"environment": environment_log(truth), "drivers": driver_log(truth)}
        readings = read_fused(align(deviations_of(truth), fields_of(truth), axis, **logs))
        course = DRIFTS[drift](readings.seconds, np.random.default_rng([seed, 5]).uniform())
        along = [np.ones_like(readings.share), readings.share, 0.7 + 0.3 * readings.share][number % 3]
        size = np.sqrt(np.mean(((course - course.mean()) * along) ** 2)) or 1.0
        response = readings.response + SMOOTH_UM / size * course * along
        model = fit_model(replace(readings, response=response), declare(readings, [*errors], library()))
        true = {"axis_expansion": recipe.drift.expansion_ppm_per_K, "table_offset": recipe.drift.offset_um_per_K}
        for term, (way, one) in product(model.terms, enumerate((model, average_over_drifts(model)))):
            (coefficient,) = coefficients_of(one, term)
            errors[term.effect][way, :, number] = float(coefficient.value) - true[term.effect], float(coefficient.u)
    told = []
    for name, of_name in errors.items():
        for way, (error, u) in zip(("fit alone", "reported"), of_name, strict=True):
            covered = int((np.abs(error) <= 2.0 * u).sum())
            told.append((way, covered))
            with capsys.disabled():
                rms = np.sqrt(np.mean(error**2))
                print(
                    f"\n{drift}, {name}, {way}: rms error {rms:.3f}, median u {np.median(u):.3f}, within 2 u {rate(covered, runs)}"
                )
    assert all(wilson(covered, runs)[1] >= 0.9 for way, covered in told if way == "reported")


def coefficients_beside_unseen_heat(seed: int) -> list[tuple[float, float]]:
    """Errors and uncertainties of expansion and shift where a source of 0.4 to 1 um, flat or linear in turn, follows the same load."""
    size_um = float(np.exp(np.random.default_rng([seed, 3]).uniform(np.log(0.4), np.log(1.0))))
    source = effect_of(f"unseen_heat_source:{('flat', 'linear')[seed % 2]}", size_um, seed)
    found = close_loop(readings_of(source, seed=seed, cycles=40), DECLARED)
    true = Recipe().drift.expansion_ppm_per_K, Recipe().drift.offset_um_per_K
    return [
        (float(one.value or np.nan) - truth, float(one.u or np.nan))
        for one, truth in zip(found.declared_coefficients[:2], true, strict=True)
    ]


def test_coefficients_beside_an_effect_of_the_same_heat_are_covered(capsys: pytest.CaptureFixture[str]) -> None:
    runs, first = campaigns(60), first_seed(89000)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        found = np.array(list(pool.map(coefficients_beside_unseen_heat, range(first, first + runs))))
    for name, (error, u) in zip(("axis_expansion", "table_offset"), found.transpose(1, 2, 0), strict=True):
        covered = int((np.abs(error) <= 2.0 * u).sum())
        with capsys.disabled():
            print(
                f"\n{name}: median u {np.median(u):.3f}, rms of error / u {np.sqrt(np.mean((error / u) ** 2)):.2f}, ",
                end="",
            )
            print(f"within 2 u {rate(covered, runs)}")
        assert wilson(covered, runs)[1] >= 0.95, name


@pytest.mark.parametrize(
    ("name", "changes", "u", "celsius"),
    [
        ("paint 0.97, 25 degC", {"emissivity": 0.97}, {}, 25.0),
        (
            "0.90, 60 degC, 3 m, window 0.95",
            {"emissivity": 0.90, "object_distance_m": 3.0, "window_transmission": 0.95, "window_temperature_K": 295.15},
            {"window_transmission": 0.01, "window_temperature_K": 1.0},
            60.0,
        ),
        ("steel 0.35 +- 0.05, 35 degC", {"emissivity": 0.35}, {"emissivity": 0.05}, 35.0),
        ("0.995, 60 degC", {"emissivity": 0.995}, {}, 60.0),
        ("paint 0.97, 0.02 m", {"emissivity": 0.97, "object_distance_m": 0.02}, {}, 25.0),
        ("metal 0.15 +- 0.04, 35 degC", {"emissivity": 0.15}, {"emissivity": 0.04}, 35.0),
    ],
)
def test_first_order_against_an_independent_monte_carlo(
    name: str, changes: dict[str, float], u: dict[str, float], celsius: float, capsys: pytest.CaptureFixture[str]
) -> None:
    """Own draws through the formula itself, frame by frame: what the comparison inside the program has to come to."""
    nominal = override(PARAMETERS, **{"object_distance_m": 1.2, "reflected_temperature_K": 295.15, **changes})
    inputs = InputUncertainty(**u, reflected_change_K=0.0)
    black = override(PARAMETERS, emissivity=1.0, object_distance_m=0.0)
    rng, errors = np.random.default_rng(5), []
    reading = temperature_from_counts(counts_from_temperature([celsius, celsius + 5.0], nominal), black)
    for _ in range(5_000):
        drawn = {}
        for key, high in (
            ("emissivity", 1.0), ("relative_humidity", 1.0), ("window_transmission", 1.0), ("object_distance_m", np.inf),
            ("reflected_temperature_K", np.inf), ("atmospheric_temperature_K", np.inf), ("window_temperature_K", np.inf),
        ):  # fmt: skip
            value, size = getattr(nominal, key), getattr(inputs, key)
            drawn[key] = value if size == 0 else _truncated(rng, value, size, high)
        offset, scale = rng.normal(0, inputs.camera_offset_K), rng.normal(0, inputs.camera_scale)
        counts = counts_from_temperature(reading * (1 + scale) + offset, black)
        errors.append(temperature_from_counts(counts, override(nominal, **drawn)) - [celsius, celsius + 5.0])
    error = np.nan_to_num(np.array(errors), nan=np.inf)
    half = [np.quantile(np.abs(one), 0.95) / 1.96 for one in (error[:, 0], error[:, 1] - error[:, 0])]
    first = [
        float(temperature_uncertainty(celsius, nominal, inputs).common_u),
        float(temperature_rise_uncertainty(celsius + 5.0, celsius, nominal, inputs).common_u),
    ]
    of_temperature, of_rise = monte_carlo_ratio([celsius], (celsius, celsius + 5.0), nominal, inputs)
    with capsys.disabled():
        print(
            f"\n{name}: temperature {first[0]:.4f} K, Monte Carlo / first order {half[0] / first[0]:.3f}; "
            f"rise of 5 K {first[1]:.4f} K, {half[1] / first[1]:.3f}"
        )
    # 5,000 draws give the half-width to 1.5 %, and to 3 % in the long tail of metal.
    assert of_temperature[0] == pytest.approx(half[0] / first[0], rel=0.06)
    assert of_rise == pytest.approx(half[1] / first[1], rel=0.1)


def _truncated(rng: np.random.Generator, value: float, u: float, high: float) -> float:
    below, above = stats.norm.cdf([(1e-3 - value) / u, (high - value) / u])
    return float(value + u * stats.norm.ppf(rng.uniform(below, above)))
