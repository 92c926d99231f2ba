"""The plots show the numbers that they promise, the paper's figures among them."""

from __future__ import annotations

from collections.abc import Iterator

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest

from interferometry import InterferometryError, plots
from interferometry.drift.estimate import estimate_drift
from tests.interferometry.simulated_campaigns import SIGMA_UM, simulate

mpl.use("Agg")


@pytest.fixture(autouse=True)
def figures_are_closed() -> Iterator[None]:
    yield
    plt.close("all")


def test_figures_6_and_13_differ_by_the_common_start(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=12)
    shifted = plots.evaluate_common_start(deviations)
    assert float(shifted["deviation"].isel(target=0).std("cycle").max()) < 1e-12
    assert float(deviations["deviation"].isel(target=0).std("cycle").max()) > SIGMA_UM
    assert plots.plot_deviations(deviations, direction="negative").get_title() == "negative approach"
    lines = plots.plot_deviations(deviations, common_start=True).lines
    assert len(lines) == 12
    assert np.asarray(lines[7].get_ydata()) == pytest.approx(shifted["deviation"].values[7, 0])


def test_figure_7_is_one_position(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=12)
    line = plots.plot_position(deviations).lines[0]
    assert np.asarray(line.get_ydata()) == pytest.approx(deviations["deviation"].values[:, 0, 3])
    # Cycles start every 252 s.
    assert np.diff(np.asarray(line.get_xdata())) == pytest.approx(252 / 3600)
    timeless = deviations.assign(time=deviations["time"].copy(data=np.full((12, 2, 16), np.datetime64("NaT", "ns"))))
    assert plots.plot_position(timeless).get_xlabel() == "cycle"
    with pytest.raises(InterferometryError, match="target=17 is not one of"):
        plots.plot_position(deviations, target=17)


def test_profile_and_drift_are_those_of_the_estimate(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=12)
    estimated = estimate_drift(deviations)
    profile = plots.plot_profile(deviations, estimated).lines[0]
    assert np.asarray(profile.get_ydata()) == pytest.approx(estimated["profile"].values[0])
    ax = plots.plot_drift(deviations, estimated, direction="negative")
    assert len(ax.lines) == 16 and len(ax.collections) == 2
    assert np.asarray(ax.lines[5].get_ydata()) == pytest.approx(estimated["drift_since_first"].values[:, 1, 5])
    assert len(plots.plot_position(deviations, estimated, target=2).collections) == 2


def test_figures_10_to_12_say_which_quantity_they_show(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=12)
    estimated = estimate_drift(deviations)
    conventional, differenced, free = plots.plot_scatter(deviations, estimated).lines
    assert (len(conventional.get_xdata()), len(differenced.get_xdata())) == (16, 15)
    assert np.asarray(free.get_ydata()) == pytest.approx(estimated["scatter_position"].values)
    assert len(plots.plot_differences(deviations).containers) == 2
    for border, what in (("border_u", "±2 u of the mean"), ("border_s", "±2 s of the differences")):
        legend = plots.plot_reference_chart(deviations, border=border).get_legend()
        assert what in legend.get_title().get_text()


def test_plots_draw_into_given_axes(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=5)
    _, ax = plt.subplots()
    assert plots.plot_deviations(deviations, ax) is ax
