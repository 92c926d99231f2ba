"""The figures of the paper: their numbers, and that they are drawn."""

from __future__ import annotations

import math

import matplotlib as mpl
import numpy as np
import pytest

from interferometry import figures
from tests.interferometry.simulated_campaigns import SIGMA_UM, simulate

mpl.use("Agg")


def test_figure_1_has_the_ratio_of_equation_10() -> None:
    densities = figures.evaluate_distributions(samples=100_000)
    assert float(densities["ratio"]) == pytest.approx(math.sqrt(2), abs=0.01)
    width = float(np.diff(densities["value"].values[:2])[0])
    assert float(densities["source"].sum()) * width == pytest.approx(1.0, abs=0.001)
    assert figures.plot_distributions(densities).get_xlabel()


def test_figure_2_adds_the_mean_difference_to_the_first_cycle(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=12)
    pair = figures.evaluate_best_estimate(deviations, link=5)
    x = deviations["deviation"].values[:, 0, :]
    assert float(pair["estimate"].sel(direction="positive")) == pytest.approx(x[0, 3] - (x[:, 3] - x[:, 4]).mean())
    with pytest.raises(ValueError, match="link=1 is not one of"):
        figures.evaluate_best_estimate(deviations, link=1)
    figures.plot_best_estimate(pair)


def test_figures_6_and_13_differ_by_the_common_start(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=12)
    measured = figures.evaluate_deviation_chart(deviations)
    shifted = figures.evaluate_common_start(deviations)
    assert float(shifted["deviation"].isel(target=0).std("cycle").max()) < 1e-12
    assert float(measured["deviation"].isel(target=0).std("cycle").max()) > SIGMA_UM
    assert figures.plot_deviation_chart(measured, direction="negative").get_title() == "negative approach"
    lines = figures.plot_deviation_chart(shifted).lines
    assert len(lines) == 12
    assert np.asarray(lines[7].get_ydata()) == pytest.approx(shifted["deviation"].values[7, 0])


def test_figure_7_is_one_position(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=12)
    history = figures.evaluate_position_history(deviations, target=4)
    line = figures.plot_position_history(history).lines[0]
    assert np.asarray(line.get_ydata()) == pytest.approx(deviations["deviation"].values[:, 0, 3])
    # Cycles start every 252 s.
    assert np.diff(np.asarray(line.get_xdata())) == pytest.approx(252 / 3600)
    timeless = history.assign(time=history["time"].copy(data=np.full((12, 2), np.datetime64("NaT", "ns"))))
    assert figures.plot_position_history(timeless).get_xlabel() == "cycle"
    with pytest.raises(ValueError, match="target=17 is not one of"):
        figures.evaluate_position_history(deviations, target=17)


def test_figures_10_to_12_say_which_quantity_they_show(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=12)
    scatter = figures.evaluate_pair_scatter(deviations)
    assert "equation (6)" in figures.plot_pair_scatter(scatter).get_ylabel()
    assert "sample standard deviation" in figures.plot_pair_scatter(scatter, quantity="standard_deviation").get_ylabel()
    mutual = figures.evaluate_mutual_deviations(deviations)
    assert len(figures.plot_mutual_deviations(mutual).containers) == 2
    chart = figures.evaluate_reference_chart(deviations)
    for border, what in (("border_u", "±2 u of the mean"), ("border_s", "±2 s of the differences")):
        legend = figures.plot_reference_chart(chart, border=border).get_legend()
        assert what in legend.get_title().get_text()


def test_figures_draw_into_given_axes(rng: np.random.Generator) -> None:
    import matplotlib.pyplot as plt

    deviations, _ = simulate(rng, cycles=5)
    _, ax = plt.subplots()
    assert figures.plot_deviation_chart(figures.evaluate_deviation_chart(deviations), ax) is ax
    plt.close("all")
