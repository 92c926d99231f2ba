"""Regions, thermal modes and clusters of fields of known truth."""

import numpy as np
import pytest

from fusion.attribution.attribute import correlate
from fusion.attribution.leading_source import find_source
from fusion.attribution.thermal_modes import RegionError, cluster_cells, disc, localise_modes, read_regions, varimax
from tests.fusion import field_simulator as simulator

SOURCES = [disc(f"source {k}", 10 * c + 5, 10 * r + 5, 30) for k, (r, c) in enumerate(simulator.SOURCES)]


@pytest.fixture(scope="module")
def driven():
    return simulator.driven_session(np.random.default_rng(4), source=1)


@pytest.fixture(scope="module")
def maps(driven):
    return correlate(driven.fused, driven.field[:, ::2, ::2], regions=SOURCES, draws=99, checks=20, per_target=True)


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
    ("text", "message"),
    [
        ("name,x_mm\na,1\n", r"regions.csv:1: no column y_mm; the first line must read name,x_mm,y_mm"),
        (
            "name,x_mm,y_mm\na,1,left\n",
            r"regions.csv:2: 'a', '1', 'left' is no corner; write a name and two numbers in mm",
        ),
        ("name,x_mm,y_mm\na,1,1\na,2,2\n", r"region 'a' has 2 corners; an outline needs at least 3"),
        ("name,x_mm,y_mm\n", r"lists no region; write one line per corner, or leave plan.regions out"),
    ],
)
def test_bad_regions_are_refused(tmp_path, text, message):
    path = tmp_path / "regions.csv"
    path.write_text(text)
    with pytest.raises(RegionError, match=message):
        read_regions(path)


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


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"name,x_mm,y_mm\nm\xfftor,1,2\n", "byte 16 is not UTF-8; save the file as CSV in UTF-8"),
        (b'name,x_mm,y_mm\n"' + b"x" * 140_000 + b'",1,2\n', "is not CSV (field larger than field limit"),
    ],
)
def test_a_damaged_file_of_regions_is_named(tmp_path, content, message):
    path = tmp_path / "regions.csv"
    path.write_bytes(content)
    with pytest.raises(RegionError) as error:
        read_regions(path)
    assert str(error.value).startswith(f"{path}: {message}")
