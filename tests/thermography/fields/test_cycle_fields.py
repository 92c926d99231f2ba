"""Cycles assembled from known parts, the noise of images, and the conventions of the written fields by the official checker."""

import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from tests.thermography.flir_mutations import PARAMETERS
from tests.thermography.plan_scene import GRID, START, Scene, record, registered
from thermography import large_arrays
from thermography.common import ThermographyError
from thermography.fields.cycle_fields import (
    SURFACE_EDGE,
    CyclePart,
    assemble_fields,
    noise_of_differences,
    pixel_noise,
    variance_of_columns,
)
from thermography.fields.moving import reduce_moving_frames
from thermography.fields.still import reduce_frames
from thermography.fields.total_uncertainty import (
    EmissivityRegion,
    calibrate_surfaces,
    find_surfaces,
    measure_emissivity,
)
from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import counts_from_temperature, override, temperature_from_counts
from thermography.registration.plan import PlanGrid, Polygon

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def products(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cf")
    image = Scene(disc_K=-4.0).render()
    registration = registered()
    frames = record(folder / "a.seq", [image, image + 0.5, image + 1.0])
    bounds = START + np.arange(4) * np.timedelta64(1, "s")
    paths = {}
    for name, fields in {
        "still": reduce_frames(frames, registration, GRID, bounds),
        "moving": reduce_moving_frames(frames, registration, GRID, bounds, direction=(-1, 0)),
    }.items():
        paths[name] = folder / f"{name}.nc"
        fields.to_netcdf(paths[name], engine="h5netcdf")
    return paths


# The checker opens its own tables and sockets and leaves them to the garbage collector.
@pytest.mark.filterwarnings("ignore")
def test_official_checker_finds_nothing(products, tmp_path):
    runner = pytest.importorskip("compliance_checker.runner")
    runner.CheckSuite.load_all_available_checkers()
    report = tmp_path / "report.json"
    options = {"verbose": 0, "criteria": "strict", "output_filename": str(report), "output_format": "json"}
    _, errors = runner.ComplianceChecker.run_checker(str(products["moving"]), ["cf:1.11"], **options)
    checked = json.loads(report.read_text())["cf:1.11"]
    found = [item for level in ("high", "medium", "low") for item in checked[f"{level}_priorities"] if item["msgs"]]
    assert found == []
    assert not errors


def test_fields_come_back_equal_and_labelled(products):
    with xr.open_dataset(products["still"], engine="h5netcdf") as fields:
        assert fields["temperature"].attrs["standard_name"] == "surface_temperature"
        assert fields["x"].attrs["standard_name"] == "projection_x_coordinate"
        assert fields["cycle_time"].dtype.kind == "M"
        assert float(fields["temperature_rise"].isel(cycle=2).median()) == pytest.approx(1.0, abs=0.01)


def part(cycle, mean, *, span=0, frames=4, start_s=0.0, noise_K=0.0):
    grid = np.full((4, 6), float(mean)) if np.isscalar(mean) else mean
    return CyclePart(
        cycle, span, frames=frames, first_time=START + np.timedelta64(round(1e9 * start_s), "ns"), seconds=0.0, mean=grid,
        spread=np.full((4, 6), 0.1), noise_variance=np.full((4, 6), noise_K**2), fell_back=np.zeros((4, 6), bool),
        count=np.where(np.isfinite(grid), frames, 0),
    )  # fmt: skip


PLAN = PlanGrid(30, 20, 5)
SURE = np.zeros((4, 6, 2, 2))
WHOLE = np.ones((4, 6))


def test_rise_rate_and_noise_of_three_cycles():
    parts = [part(0, 20.0, noise_K=0.03), part(1, 21.0, start_s=1800, noise_K=0.04), part(3, 24.0, start_s=7200)]
    fields = assemble_fields(parts, 4, PLAN, [SURE], [WHOLE])
    middle = fields.isel(y=2, x=3)
    np.testing.assert_allclose(middle["temperature"], [20, 21, np.nan, 24])
    np.testing.assert_allclose(middle["temperature_rise"], [0, 1, np.nan, 4])
    # Second-order differences over 0.5 h and 1.5 h: the parabola through the three points.
    slopes = np.polynomial.Polynomial.fit([0, 0.5, 2], [20, 21, 24], 2).deriv()
    assert float(middle["temperature_rate"][1]) == pytest.approx(slopes(0.5), rel=1e-6)
    np.testing.assert_allclose(middle["temperature_noise_u"], [0.03, 0.04, np.nan, 0.0], rtol=1e-6)
    # The first cycle's noise is in every rise but its own.
    np.testing.assert_allclose(middle["temperature_rise_noise_u"], [0.0, 0.05, np.nan, 0.03], rtol=1e-6)
    assert middle["count"].values.tolist() == [4, 4, 0, 4]
    assert middle["quality_flag"].values.tolist() == [0, 0, 16, 0]


def test_very_many_cycles_are_evaluated_some_at_a_time_with_the_same_bits(monkeypatch, rng, tmp_path):
    covariance = np.zeros((4, 6, 2, 2))
    covariance[..., 0, 0], covariance[..., 1, 1] = 0.2**2, 0.5**2
    finished = large_arrays.Spool(tmp_path)
    cycles = [*range(5), 8, 9, 12]
    parts = [part(c, rng.normal(20, 1, (4, 6)), start_s=600 * c + 7 * (c % 3), noise_K=0.01 * (c + 1)) for c in cycles]
    # The last two parts are one cycle before and after a knock.
    parts.append(replace(part(12, rng.normal(20, 1, (4, 6)), start_s=7300), span=1))
    for one in parts:
        finished.append(one)
    assert [one.cycle for one in finished] == [one.cycle for one in parts]
    assert finished[-1].span == 1 and len(finished[2:4]) == 2
    at_once = assemble_fields(parts, 14, PLAN, [covariance] * 2, [WHOLE] * 2)
    for limit in (1, 4 * 6 * 8 * 3):
        monkeypatch.setattr(large_arrays, "PIECE_BYTES", limit)
        monkeypatch.setattr(large_arrays, "IN_MEMORY_BYTES", limit)
        in_turns = assemble_fields(finished, 14, PLAN, [covariance] * 2, [WHOLE] * 2, folder=tmp_path)
        for name in at_once.variables:
            assert at_once[name].values.tobytes() == in_turns[name].values.tobytes(), (limit, name)


def test_position_uncertainty_enters_through_the_gradient():
    ramp = np.broadcast_to(20 + 0.1 * PLAN.x_mm, (4, 6)).copy()
    covariance = np.zeros((4, 6, 2, 2))
    covariance[..., 0, 0], covariance[..., 1, 1] = 0.2**2, 0.5**2
    fields = assemble_fields([part(0, ramp)], 1, PLAN, [covariance], [WHOLE])
    # 0.1 K/mm along x only, with 0.2 mm; the outermost cells are smoothed.
    assert float(fields["temperature_noise_u"][0, 2, 2]) == pytest.approx(0.02, rel=0.05)
    assert float(fields["position_u"][2, 2]) == pytest.approx(np.hypot(0.2, 0.5), rel=1e-6)


def test_a_cycle_under_two_registrations_is_weighted_by_frames():
    other = np.full((4, 6), 22.0)
    other[0, 0] = np.nan
    parts = [part(0, 20.0, frames=3, noise_K=0.1), part(0, other, span=1, frames=1, start_s=8, noise_K=0.2)]
    fields = assemble_fields(parts, 1, PLAN, [SURE, SURE], [WHOLE, 0.9 * WHOLE])
    assert float(fields["temperature"][0, 1, 1]) == pytest.approx(20.5)
    assert float(fields["temperature"][0, 0, 0]) == pytest.approx(20.0)
    assert float(fields["temperature_noise_u"][0, 1, 1]) == pytest.approx(np.hypot(0.75 * 0.1, 0.25 * 0.2))
    assert int(fields["quality_flag"][0, 1, 1]) == 4
    assert fields["cycle_time"].values[0] == START + np.timedelta64(2, "s")


@pytest.mark.parametrize("shape", [(100, 120), (480, 640)])
def test_noise_of_an_image_ignores_its_smooth_field(rng, shape):
    row, column = np.mgrid[: shape[0], : shape[1]]
    smooth = 20 + 0.05 * column - 0.03 * row + 1e-4 * column * row
    image, used = smooth + rng.normal(0, 0.05, shape), np.ones(shape, bool)
    # 10,000 pixels and more give it to 1 %.
    assert pixel_noise(image, used) == pytest.approx(0.05, rel=0.03)
    used[::4] = False
    assert np.isnan(pixel_noise(image, used & False))
    interior = np.zeros(shape, bool)
    interior[10:90, 10:110] = True
    assert noise_of_differences(image, interior) == pytest.approx(0.05, rel=0.05)


def test_noise_of_columns_is_told_from_that_of_pixels(rng):
    row, column = np.mgrid[:90, :160]
    smooth = 20 + 3 * np.exp(-((row - 40) ** 2 + (column - 70) ** 2) / 200)
    image, interior = smooth + rng.normal(0, 0.05, smooth.shape), np.ones(smooth.shape, bool)
    interior[30:40, 50:60] = False
    assert variance_of_columns(image, interior) == 0.0
    # The median of 156 columns whose fourth differences resemble one another.
    shared = variance_of_columns(image + rng.normal(0, 0.1, 160), interior)
    assert np.sqrt(shared) == pytest.approx(0.1, rel=0.3)
    assert variance_of_columns(image[:, :20], interior[:, :20]) == 0.0


CAMERA = override(PARAMETERS, emissivity=0.97, object_distance_m=1.2, reflected_temperature_K=295.15)
TABLE = PlanGrid(100, 60, 5)
TABLE_SURE, TABLE_WHOLE = np.zeros((*TABLE.shape, 2, 2)), np.ones(TABLE.shape)
STEEL = Polygon("steel", np.array([(0, 0), (40, 0), (40, 60), (0, 60)]))
BARE = EmissivityRegion(STEEL, 0.35, 0.05)
TRUE = (25.0, 30.0, 35.0)


def steel_beside_paint(coverage: np.ndarray = TABLE_WHOLE) -> xr.Dataset:
    """Fields of a table of one temperature, its left part bare steel, all calibrated as paint."""
    parts = []
    for cycle, celsius in enumerate(TRUE):
        counts = counts_from_temperature(celsius, CAMERA, emissivity=np.where(TABLE.x_mm < 40, 0.35, 0.97))
        field = np.broadcast_to(temperature_from_counts(counts, CAMERA), TABLE.shape).copy()
        one = part(cycle, 0.0, start_s=600.0 * cycle)
        shaped = {name: np.full(TABLE.shape, value) for name, value in (("spread", 0.1), ("noise_variance", 1e-4))}
        parts.append(replace(one, mean=field, fell_back=field < 0, count=np.full(TABLE.shape, 4), **shaped))
    stack = np.stack([one.mean for one in parts]).astype(np.float32)
    return assemble_fields(
        parts, 3, TABLE, [TABLE_SURE], [coverage], frames={"frame_temperature": (("time", "y", "x"), stack)}
    )  # fmt: skip


def calibrated(fields: xr.Dataset, regions: list[EmissivityRegion]) -> xr.Dataset:
    surfaces, edge = find_surfaces(fields, regions, emissivity=0.97, emissivity_u=0.01)
    cameras: dict[str, list[CameraParameters]] = {"cycle": [CAMERA] * 3, "time": [CAMERA] * 3}
    return calibrate_surfaces(fields, surfaces, edge, cameras)


def test_bare_steel_beside_paint_has_the_temperature_of_the_table():
    raw = steel_beside_paint()
    assert float(raw["temperature"][2, 0, 0]) < 28.0
    done = calibrated(raw, [BARE])
    for name in ("temperature", "frame_temperature"):
        for cycle, celsius in enumerate(TRUE):
            field = done[name][cycle].values
            np.testing.assert_allclose(field[np.isfinite(field)], celsius, atol=1e-4)
    np.testing.assert_allclose(done["temperature_rise"][2, 0, [0, 15]], 10.0, atol=1e-4)
    np.testing.assert_allclose(done["temperature_rate"][1, 0, [0, 15]], 30.0, rtol=1e-4)
    # A camera sees steel through 0.35 of its radiation, so that its noise is 0.97 / 0.35 times that of paint, less the curvature.
    steel, paint = done["temperature_noise_u"].values[0, 0, [0, 15]]
    assert steel / paint == pytest.approx(2.7, rel=0.05)


def test_cells_at_the_edge_of_a_surface_are_empty_and_a_later_region_covers():
    done = calibrated(steel_beside_paint(), [BARE])
    empty = np.isnan(done["temperature"][0].values)
    assert np.flatnonzero(empty[0]).tolist() == [7, 8]
    assert ((done["quality_flag"][0].values & SURFACE_EDGE > 0) == empty).all()
    crossing = EmissivityRegion(Polygon("steel", np.array([(0, 0), (42, 0), (42, 60), (0, 60)])), 0.35, 0.05)
    crossed = calibrated(steel_beside_paint(), [crossing])["temperature"][0, 0]
    assert np.flatnonzero(np.isnan(crossed)).tolist() == [7, 8]
    coverage = TABLE_WHOLE.copy()
    coverage[3, 9] = 0.8
    assert np.isnan(calibrated(steel_beside_paint(coverage), [BARE])["temperature"][0, 3, 9])
    tape = EmissivityRegion(Polygon("tape", np.array([(10, 10), (30, 10), (30, 50), (10, 50)])), 0.95, 0.01)
    surfaces, _ = find_surfaces(steel_beside_paint(), [BARE, tape], emissivity=0.97, emissivity_u=0.01)
    assert [surface.name for surface in surfaces] == ["", "steel", "tape"]
    assert surfaces[2].cells[5, 4] and not surfaces[1].cells[5, 4]
    assert not (surfaces[0].cells & surfaces[1].cells).any()
    strip = EmissivityRegion(Polygon("strip", np.array([(20, 0), (28, 0), (28, 60), (20, 60)])), 0.35, 0.05)
    with pytest.raises(ThermographyError, match="region strip: no cell lies inside and away from its edge"):
        find_surfaces(steel_beside_paint(), [strip], emissivity=0.97, emissivity_u=0.01)


def test_emissivity_from_two_cycles_of_known_temperature():
    states = [(1, 25.0, 0.1), (3, 35.0, 0.1)]
    found = measure_emissivity(steel_beside_paint(), STEEL, states, CAMERA, camera_scale=0.0)
    assert found.emissivity == pytest.approx(0.35, abs=1e-4)
    # Two temperatures of 0.1 K over 10 K are 1.4 %.
    assert found.emissivity_u == pytest.approx(0.014 * 0.35, rel=0.1)
    scaled = measure_emissivity(steel_beside_paint(), STEEL, states, CAMERA, camera_scale=0.02)
    assert scaled.emissivity_u == pytest.approx(np.hypot(found.emissivity_u, 0.007), rel=1e-3)
    raw = steel_beside_paint()
    with pytest.raises(ThermographyError, match="there is no cycle 9; name a measured one"):
        measure_emissivity(raw, STEEL, [(1, 25.0, 0.1), (9, 35.0, 0.1)], CAMERA, camera_scale=0.0)
    with pytest.raises(ThermographyError, match=r"region steel: the two states give an emissivity of 0\.35 with a"):
        measure_emissivity(raw, STEEL, [(1, 25.0, 2.0), (2, 30.0, 2.0)], CAMERA, camera_scale=0.0)
    empty = raw.assign(temperature=raw["temperature"].where(raw["x"] > 40))
    with pytest.raises(ThermographyError, match="cycle 1 shows no cell of it"):
        measure_emissivity(empty, STEEL, [(1, 25.0, 0.1), (3, 35.0, 0.1)], CAMERA, camera_scale=0.0)
