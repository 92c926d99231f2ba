"""Maps of the attribution show what was tested, and say how often they are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.products.store import read_tree
from fusion.report import plots_attribution


@pytest.fixture
def fused(results_folder: Path) -> xr.DataTree:
    return read_tree(results_folder / "fusion.nc")


def test_a_map_shows_its_channel(fused: xr.DataTree) -> None:
    maps = fused.children["correlation"]
    cells = maps.to_dataset()
    ax = plots_attribution.plot_cells(cells, "p_value", "reversal", label="p")
    np.testing.assert_array_equal(ax.images[0].get_array(), cells["p_value"].sel(channel="reversal"))
    assert ax.get_title() == "drift of the reversal"
    clusters = maps.children["clusters"].to_dataset()
    assert len(plots_attribution.plot_clusters(clusters).texts) == int(clusters["cluster"].max())


def test_modes_and_regions_are_drawn_each(fused: xr.DataTree) -> None:
    maps = fused.children["correlation"]
    modes = maps.children["modes"].to_dataset()
    ax = plots_attribution.plot_modes(modes, "common")
    figure = ax.get_figure()
    assert figure is not None
    assert sum(axes.get_visible() for axes in figure.axes) == modes.sizes["mode"]
    if "target_regions" in maps.children:
        targets = maps.children["target_regions"].to_dataset()
        region = str(targets["region"].values[0])
        position = fused.to_dataset()["position"]
        assert plots_attribution.plot_region_targets(targets, region, position).get_title() == region


def test_a_rate_carries_its_own_uncertainty() -> None:
    # Binomial: sqrt(0.05 * 0.95 / 200) = 1.54 %, and twice that is stated.
    assert plots_attribution.rate_text(0.05, checks=200) == "5.0 \u00b1 3.1 %"


def test_the_caption_states_false_alarms_and_detection_limit(fused: xr.DataTree) -> None:
    text = plots_attribution.caption_of(fused.children["correlation"], "common")
    assert text.startswith("False alarms of this map, in simulations without a source: ")
    assert "Detection limit at 80 % power: " in text
