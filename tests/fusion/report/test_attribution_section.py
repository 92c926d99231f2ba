"""The section on drift and field: what leads, what it is worth, what sensors would lose."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.products.results import CorrelationPart, Results, read_results
from fusion.products.store import read_tree
from fusion.report.attribution_section import describe_correlation
from fusion.report.wording import region_words


@pytest.fixture
def parts(results_folder: Path) -> tuple[xr.DataTree, Results]:
    return read_tree(results_folder / "fusion.nc"), read_results(results_folder)


def correlation_of(results: Results) -> CorrelationPart:
    assert results.correlation is not None
    return results.correlation


def test_every_part_of_the_drift_has_its_strongest_cell(parts: tuple[xr.DataTree, Results]) -> None:
    fused, results = parts
    correlation = correlation_of(results)
    told = describe_correlation(fused, results, None)
    assert told is not None
    names = [row.cells[0] for row in told["cells"].rows]
    assert names == ["common", "growing", "reversal", "common and growing"]
    modes = next(place for place in told["places"] if place.title == "Thermal modes")
    assert len(modes.strongest.rows) == len(correlation.modes)
    assert len(modes.every.rows) == 4 * len(correlation.modes)
    assert modes.strongest.columns[-1].title == "p given the leading mode"


def test_two_sessions_decide_what_is_a_cause(parts: tuple[xr.DataTree, Results]) -> None:
    fused, results = parts
    correlation = correlation_of(results)
    agreed = describe_correlation(fused, results, {"other": "Tuesday", "causes": ["x 1 mm, y 2 mm"], "rows": []})
    assert agreed is not None
    assert agreed["sentences"][-1] == "It is a cause where Tuesday agrees: x 1 mm, y 2 mm (below)."
    attributable = correlation.model_copy(update={"verdict": "attributable"})
    alone = describe_correlation(fused, results.model_copy(update={"correlation": attributable}), None)
    assert alone is not None and alone["sentences"][-1].startswith("Causation is not shown yet: in one session")


def test_sensors_that_lose_less_than_fewer_are_named(parts: tuple[xr.DataTree, Results]) -> None:
    fused, results = parts
    correlation = correlation_of(results)
    told = describe_correlation(fused, results, None)
    assert told is not None
    losses = [np.inf if one.loss_um is None else one.loss_um for one in correlation.sensors.sets]
    verdicts = [row.cells[-1] for row in told["sensors_table"].rows]
    for k, verdict in enumerate(verdicts):
        assert verdict.endswith("fewer sensors do as well") == (k > 0 and losses[k] > min(losses[:k]))


def test_nothing_is_told_where_nothing_was_tested(parts: tuple[xr.DataTree, Results]) -> None:
    fused, results = parts
    assert describe_correlation(fused, results.model_copy(update={"correlation": None}), None) is None
    assert json.dumps(correlation_of(results).would_tell)


def test_every_chart_of_a_mode_names_mode_and_area(parts: tuple[xr.DataTree, Results]) -> None:
    fused, results = parts
    told = describe_correlation(fused, results, None)
    assert told is not None
    modes = fused.children["correlation"].children["modes"]["mode"].values
    assert list(told["mode_captions"]) == [f"mode_{mode}" for mode in modes]
    for mode, caption in zip(modes, told["mode_captions"].values(), strict=True):
        assert caption.startswith(f"Thermal mode {mode}, x ")


def test_the_disc_about_a_hotspot_is_not_called_as_the_hotspot(parts: tuple[xr.DataTree, Results]) -> None:
    assert region_words("hotspot 12") == "disc about hotspot 12" and region_words("hotspot plate") == "hotspot plate"
    fused, results = parts
    told = describe_correlation(fused, results, None)
    assert told is not None
    regions = next(place for place in told["places"] if place.title.startswith("Regions"))
    named = [row.cells[0] for row in regions.strongest.rows]
    assert named == [region_words(region.name) for region in correlation_of(results).regions]
    assert not any(name.startswith("hotspot") for name in named)
