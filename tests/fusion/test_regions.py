"""Regions, modes, evidence and clusters of films of known truth."""

import numpy as np
import pytest

from fusion.collinearity import carry_evidence, cluster_cells, evidence_at
from fusion.correlation import CorrelationError, correlate
from fusion.regions import Disc, correlate_modes, correlate_regions, varimax
from tests.fusion import film_simulator as simulator

SOURCES = {f"source {k}": Disc(10 * c + 5, 10 * r + 5, 30) for k, (r, c) in enumerate(simulator.SOURCES)}


@pytest.fixture(scope="module")
def driven():
    return simulator.driven_session(np.random.default_rng(4), source=1)


def test_the_region_that_drives_the_axis_is_named_with_its_sensitivity(driven):
    found = correlate_regions(driven.fused, driven.field, SOURCES, draws=99)
    common = found.sel(channel="common")
    assert float(common["p_value"].sel(region="source 1")) == pytest.approx(0.01)
    assert int(np.argmax(common["statistic"].values)) == 1
    # 3 um per 3 K at the centre; the disc of 3 cells radius in a halo of 5 cells sees 0.84 of that rise.
    sensitivity = float(common["sensitivity"].sel(region="source 1"))
    assert sensitivity == pytest.approx(1 / 0.84, abs=4 * float(common["sensitivity_u"].sel(region="source 1")))


def test_modes_separate_sources_and_name_the_right_one(driven):
    found = correlate_modes(driven.fused, driven.field, draws=99)
    joint = found.sel(channel="joint")
    strongest = joint.isel(region=int(np.argmax(joint["statistic"].values)))
    place = float(strongest["peak_y"]) / 10 - 0.5, float(strongest["peak_x"]) / 10 - 0.5
    assert simulator.distance_cells(*place, 1) <= 5
    assert float(strongest["p_value"]) <= 0.05
    assert float(np.nanmax(strongest["pattern"])) == pytest.approx(1.0)


def test_a_region_outside_the_plan_is_refused(driven):
    with pytest.raises(CorrelationError, match=r"region 'far' at x = 5000 mm, y = 0 mm holds no seen cell"):
        correlate_regions(driven.fused, driven.field, {"far": Disc(5000, 0, 20)})


def test_a_still_field_has_no_modes(driven, rng):
    still = driven.field.copy(data=20.0 + 0.03 * rng.standard_normal(driven.field.shape))
    with pytest.raises(CorrelationError, match="no thermal mode stands above the film's noise"):
        correlate_modes(driven.fused, still)


def test_varimax_undoes_a_rotation_of_localised_patterns(rng):
    patterns = np.zeros((60, 3))
    for k in range(3):
        patterns[20 * k : 20 * (k + 1), k] = rng.uniform(0.5, 1.0, 20)
    mixed = patterns @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
    back = np.abs(mixed @ varimax(mixed))
    # Each row again loads on one column only; the criterion stops at 1e-6.
    assert np.sort(back, axis=1)[:, :2].max() < 1e-2


def test_evidence_names_place_size_and_what_cannot_be_told_apart(driven):
    maps = correlate(driven.fused, driven.field[:, ::2, ::2], draws=99, checks=1)
    found = carry_evidence(maps)
    assert found.p_value <= 0.05
    assert found.area_mm2 >= 400.0
    assert "um/K at x = " in found.sentence()
    near = evidence_at(maps, found.x_mm + 3, found.y_mm - 3)
    assert near["p_value"] == pytest.approx(0.01)


def test_two_places_on_one_heat_source_form_one_cluster(rng):
    courses = np.cumsum(rng.standard_normal((100, 2)), axis=0)
    film = np.zeros((100, 6, 9))
    film[:, :, :3] = courses[:, 0, None, None] * np.array([1.0, 0.5, 0.8])
    film[:, :, 6:] = courses[:, 1, None, None] * np.array([0.7, 0.9, 0.4])
    field = simulator.session(film + 0.01 * rng.standard_normal(film.shape), courses[:, 0], courses[:, 1], rng).field
    clusters = cluster_cells(field)["cluster"].values
    assert len(np.unique(clusters[:, :3])) == 1
    assert len(np.unique(clusters[:, 6:])) == 1
    assert clusters[0, 0] != clusters[0, 8]
    assert float(cluster_cells(field)["condition"]) < 10
