"""The section on drift and field: what leads, what it is worth, what sensors would lose."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.products.results import CorrelationPart, read_results
from fusion.products.store import read_tree
from fusion.report.attribution_section import describe_correlation


@pytest.fixture
def parts(results_folder: Path) -> tuple[xr.DataTree, CorrelationPart]:
    correlation = read_results(results_folder).correlation
    assert correlation is not None
    return read_tree(results_folder / "fusion.nc"), correlation


def test_every_part_of_the_drift_has_its_strongest_cell(parts: tuple[xr.DataTree, CorrelationPart]) -> None:
    fused, correlation = parts
    told = describe_correlation(fused, correlation, None)
    assert told is not None
    names = [row.cells[0] for row in told["cells"].rows]
    assert names == ["common", "growing", "reversal", "common and growing"]
    modes = next(place for place in told["places"] if place.title == "Thermal modes")
    assert len(modes.strongest.rows) == len(correlation.modes)
    assert len(modes.every.rows) == 4 * len(correlation.modes)
    assert modes.strongest.columns[-1].title == "p given the leading mode"


def test_two_sessions_decide_what_is_a_cause(parts: tuple[xr.DataTree, CorrelationPart]) -> None:
    fused, correlation = parts
    agreed = describe_correlation(fused, correlation, {"other": "Tuesday", "causes": ["x 1 mm, y 2 mm"], "rows": []})
    assert agreed is not None
    assert agreed["sentences"][-1] == "It is a cause where Tuesday agrees: x 1 mm, y 2 mm (below)."
    attributable = correlation.model_copy(update={"verdict": "attributable"})
    alone = describe_correlation(fused, attributable, None)
    assert alone is not None and alone["sentences"][-1].startswith("Causation is not shown yet: in one session")


def test_sensors_that_lose_less_than_fewer_are_named(parts: tuple[xr.DataTree, CorrelationPart]) -> None:
    fused, correlation = parts
    told = describe_correlation(fused, correlation, None)
    assert told is not None
    losses = [np.inf if one.loss_um is None else one.loss_um for one in correlation.sensors.sets]
    verdicts = [row.cells[-1] for row in told["sensors_table"].rows]
    for k, verdict in enumerate(verdicts):
        assert verdict.endswith("no better than fewer") == (k > 0 and losses[k] > min(losses[:k]))


def test_nothing_is_told_where_nothing_was_tested(parts: tuple[xr.DataTree, CorrelationPart]) -> None:
    assert describe_correlation(parts[0], None, None) is None
    assert json.dumps(parts[1].would_tell)
