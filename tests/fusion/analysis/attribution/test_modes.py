"""Regions, thermal modes and clusters of fields of known truth."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.analysis.attribution.correlate import correlate, find_source
from fusion.analysis.attribution.modes import (
    Excitation,
    RegionError,
    cluster_cells,
    describe_excitation,
    disc,
    localise_modes,
    nuisance_columns,
    read_regions,
    thermal_modes,
    varimax,
    warm_up_columns,
)
from tests.fusion import field_simulator as simulator


def test_the_region_that_drives_the_axis_is_named_with_its_sensitivity(maps):
    common = maps["regions"].to_dataset().sel(channel="common", region="source 1")
    assert float(common["p_value"]) <= 0.05
    ratio = maps["regions/statistic"].sel(channel="common").values
    assert int(np.argmax(ratio)) == 1
    # 3 um per 3 K at the centre; the disc of 3 cells radius in a halo of 5 cells sees 0.84 of that rise.
    u = float(common["sensitivity_u"])
    assert float(common["sensitivity"]) == pytest.approx(1 / 0.84, abs=4 * u)
    assert float(common["at_x"]) == pytest.approx(125.0)


def test_every_target_is_tested_against_every_region(maps):
    p = maps["target_regions/p_value"].sel(region="source 1")
    assert p.sizes == {"series": 32}
    # Common and stretch add up at the far end and cancel at target 1, which then does not move with the source.
    assert float(p.sel(series="positive 16")) <= 0.05
    assert float(p.sel(series="positive 1")) > 0.05


def modes_of(film, driver, rng):
    made = simulator.session(film, driver, driver, rng)
    maps = correlate(made.fused, made.field[:, ::2, ::2], draws=199, checks=1).sel(channel="joint")
    place = np.stack([maps["modes/at_y"].values / 10 - 0.5, maps["modes/at_x"].values / 10 - 0.5], axis=1)
    nearest = [int(np.argmin(np.hypot(*(place - np.array(source)).T))) for source in simulator.SOURCES[:2]]
    return maps["modes/p_value"].values[nearest], maps["modes/p_beside"].values[nearest]


def test_a_second_source_adds_to_the_leading_one(rng):
    responses = simulator.source_responses("duty", rng)[1]
    p, beside = modes_of(simulator.film("duty", rng, responses), 3.0 * (responses[:, 0] - responses[:, 1]), rng)
    # The second one is hidden by the first until that is taken as given; NaN marks the leading one.
    assert p.min() <= 0.05
    assert np.isnan(beside).sum() == 1 and np.nanmax(beside) <= 0.05


def test_a_place_that_warms_with_the_source_adds_nothing(rng):
    responses = simulator.source_responses("duty", rng)[1]
    responses[:, 1] = 0.9 * responses[:, 0] + 0.1 * responses[:, 1]
    p, beside = modes_of(simulator.film("duty", rng, responses), 3.0 * responses[:, 0], rng)
    assert (p <= 0.05).all()
    assert np.isnan(beside).sum() == 1 and np.nanmax(beside) > 0.05


def test_a_region_outside_the_plan_is_refused(driven):
    with pytest.raises(RegionError, match=r"region 'far' around x = 5000 mm, y = -?0 mm holds no seen cell"):
        correlate(driven.fused, driven.field, regions=[disc("far", 5000, 0, 20)])


def test_a_still_field_has_no_modes(driven, rng):
    still = 0.03 * rng.standard_normal((100, 60))
    assert localise_modes(still - still.mean(axis=0)).courses.shape == (100, 0)
    field = driven.field[:, ::4, ::4].copy(data=20.0 + 0.03 * rng.standard_normal((100, 6, 8)))
    maps = correlate(driven.fused, field, draws=39, checks=1)
    assert "modes" not in maps.children
    assert find_source(maps).kind == "cell"


def test_varimax_undoes_a_rotation_of_localised_patterns(rng):
    patterns = np.zeros((60, 3))
    for k in range(3):
        patterns[20 * k : 20 * (k + 1), k] = rng.uniform(0.5, 1.0, 20)
    mixed = patterns @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
    back = np.abs(mixed @ varimax(mixed))
    # Each row again loads on one column only; the criterion stops at 1e-6.
    assert np.sort(back, axis=1)[:, :2].max() < 1e-2


def test_regions_are_read_by_their_corners(tmp_path, driven):
    path = tmp_path / "regions.csv"
    path.write_text("name,x_mm,y_mm\nmotor,0,0\nmotor,100,0\nmotor,100,50\nmotor,0,50\n")
    (motor,) = read_regions(path)
    # 10 x 5 cells of 10 mm have their centre inside.
    assert motor.name == "motor" and motor.cells(driven.field).sum() == 50


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"name,x_mm\na,1\n", ":1: no column y_mm"),
        (b"name,x_mm,y_mm\na,1,left\n", ":2: 'a', '1', 'left' is no corner"),
        (b"name,x_mm,y_mm\na,1,1\na,2,2\n", ": region 'a' has 2 corners"),
        (b"name,x_mm,y_mm\n", ": lists no region"),
        (b"name,x_mm,y_mm\nm\xfftor,1,2\n", ": byte 16 is not UTF-8"),
        (b'name,x_mm,y_mm\n"' + b"x" * 140_000 + b'",1,2\n', ": is not CSV (field larger than field limit"),
    ],
)
def test_bad_regions_are_refused_with_file_and_line(tmp_path, content, told):
    path = tmp_path / "regions.csv"
    path.write_bytes(content)
    with pytest.raises(RegionError) as error:
        read_regions(path)
    assert str(error.value).startswith(f"{path}{told}")


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


# How many modes a film holds, and whether it is more than one warm-up.


SECONDS = np.arange(simulator.CYCLES) * simulator.PERIOD_S


def flat(film):
    values = film.reshape(film.shape[0], -1)
    return values - values.mean(axis=0)


def test_modes_above_the_noise_are_counted_and_rebuild_the_film(rng):
    clean = np.cumsum(rng.standard_normal((100, 3)), axis=0) @ rng.standard_normal((3, 400))
    values = clean - clean.mean(axis=0)
    courses, patterns = thermal_modes(values + 0.05 * rng.standard_normal(values.shape))
    assert courses.shape == (100, 3)
    # What is left out is noise in the three modes' own span.
    assert (courses @ patterns - values).std() < 0.02
    assert np.sqrt((courses**2).sum() / 100) == pytest.approx(values.std(), rel=0.01)


def test_noise_alone_has_no_modes(rng):
    noise = 0.03 * rng.standard_normal((100, 500))
    assert thermal_modes(noise - noise.mean(axis=0))[0].shape[1] == 0
    excitation = describe_excitation(noise, SECONDS)
    assert not excitation.warm_up_only
    assert excitation.name == "varied"


@pytest.mark.parametrize(("kind", "only"), [("warm", True), ("duty", False), ("rw", False)])
def test_one_warm_up_is_told_from_switched_and_wandering_films(kind, only):
    for seed in range(5):
        film = simulator.film(kind, np.random.default_rng([seed, 6]))
        assert describe_excitation(flat(film), SECONDS).warm_up_only is only


def test_exponentials_of_other_constants_are_within_reach_of_the_columns():
    columns = np.column_stack([np.ones(100), SECONDS, warm_up_columns(SECONDS)])
    for tau in (700.0, 2000.0, 5000.0, 9000.0):
        course = np.exp(-SECONDS / tau)
        rest = course - columns @ np.linalg.lstsq(columns, course, rcond=None)[0]
        # Far less than the hundredth of the variance that decides between a warm-up and more.
        assert rest.var() < 1e-3 * course.var()


def test_a_warm_up_that_dominates_becomes_part_of_every_hypothesis():
    assert nuisance_columns(SECONDS, Excitation(0.94, False)).shape == (100, 2)
    protected = nuisance_columns(SECONDS, Excitation(0.96, False))
    np.testing.assert_array_equal(protected[:, 2:], warm_up_columns(SECONDS))
