"""The leading source of fields of known truth, and what is recommended next."""

import numpy as np
import pytest

from fusion.attribution.attribute import correlate
from fusion.attribution.leading_source import find_source, recommend_measurement
from tests.fusion import field_simulator as simulator


@pytest.fixture(scope="module")
def maps():
    driven = simulator.driven_session(np.random.default_rng(4), source=1)
    return correlate(driven.fused, driven.field[:, ::2, ::2], draws=99, checks=20)


def test_the_answer_comes_from_the_mode_of_the_right_source(maps):
    source = find_source(maps)
    assert (source.verdict, source.kind) == ("attributable", "mode")
    assert simulator.distance_cells(source.y_mm / 10 - 0.5, source.x_mm / 10 - 0.5, 1) <= 5
    assert source.others_mm == ()
    assert 20.0 < source.width_mm < 120.0
    assert float(np.nanmax(maps["modes/pattern"])) == pytest.approx(1.0)
    assert "A second session that finds the same place" in recommend_measurement(maps, source)


def test_without_a_source_the_detection_limit_and_a_plan_are_stated(rng):
    made = simulator.null_session("rw", rng)
    maps = correlate(made.fused, made.field[:, ::4, ::4], draws=99, checks=1)
    source = find_source(maps)
    assert source.verdict == "not attributable" and source.p_value > 0.05
    text = recommend_measurement(maps, source)
    assert f"From {source.detectable_um_per_K:.2g} µm/K on" in text
    assert f'--noise "{float(maps["noise"].sel(channel="common")):.2g} um"' in text


def test_places_that_warm_alike_are_named_as_equal(rng):
    """Two halos of one switched source: nothing can tell which of them drives the axis."""
    course = simulator.source_responses("duty", rng)[1][:, 1]
    row, column = np.mgrid[: simulator.ROWS, : simulator.COLUMNS]
    halos = sum(np.exp(-((row - r) ** 2 + (column - c) ** 2) / 50.0) for r, c in simulator.SOURCES[1:])
    film = 3.0 * np.multiply.outer(course, halos) + 0.03 * rng.standard_normal((simulator.CYCLES, *row.shape))
    made = simulator.session(film, 3 * course, 3 * course, rng)
    source = find_source(correlate(made.fused, made.field[:, ::2, ::2], draws=99, checks=1))
    assert source.verdict == "attributable"
    places = [(source.x_mm, source.y_mm), *source.others_mm]
    for r, c in simulator.SOURCES[1:]:
        assert min(np.hypot(x - (10 * c + 5), y - (10 * r + 5)) for x, y in places) <= 50.0
