"""The simulated camera obeys projection, lens and radiation: geometry, counts, noise and its own errors."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fusion.twin.camera import SC660, Renderer, air_transmission, counts_of, fiducial_points, make_view
from fusion.twin.recipe import Camera, EffectRecipe, Recipe
from fusion.twin.simulate import Truth, simulate

pytestmark = pytest.mark.long

QUIET = {"netd_K": 0.0, "blur_px": 0.0}
BASE = Recipe().vary(test={"cycles": 12})


def twin(**camera: object) -> Truth:
    return simulate(BASE.vary(camera=camera))


def temperature_by_hand(counts: np.ndarray, camera: Camera) -> np.ndarray:
    """Counts to degC by the vendor's measurement formula, written here once more and step by step."""
    k, t = SC660, camera.atmospheric_temperature_degC

    def black(celsius: float) -> float:
        spectral = np.exp(k["planck_b"] / (celsius + 273.15)) - k["planck_f"]
        return k["planck_r1"] / (k["planck_r2"] * spectral) - k["planck_o"]

    omega = camera.relative_humidity * np.exp(1.5587 + 6.939e-2 * t - 2.7816e-4 * t**2 + 6.8455e-7 * t**3)
    root = np.sqrt(camera.distance_mm / 1000)
    tau = k["atmosphere_x"] * np.exp(-root * (k["atmosphere_alpha1"] + k["atmosphere_beta1"] * np.sqrt(omega)))
    tau += (1 - k["atmosphere_x"]) * np.exp(-root * (k["atmosphere_alpha2"] + k["atmosphere_beta2"] * np.sqrt(omega)))
    surface = (counts - (1 - tau) * black(t)) / tau
    surface = (surface - (1 - camera.emissivity) * black(camera.reflected_temperature_degC)) / camera.emissivity
    ratio = k["planck_r1"] / (k["planck_r2"] * (surface + k["planck_o"]))
    return k["planck_b"] / np.log(ratio + k["planck_f"]) - 273.15


def test_pixels_and_plan_are_each_others_inverse():
    view = make_view(Camera(k1=-1.2))
    points = np.random.default_rng(5).uniform([0, 0], [700, 180], (500, 2))
    np.testing.assert_allclose(view.to_plan(view.to_sensor(points)), points, atol=1e-9)


def test_lens_is_the_one_of_opencv():
    camera = Camera(k1=-1.2)
    view = make_view(camera)
    points = fiducial_points(BASE.plan)
    straight = make_view(Camera(k1=0.0)).to_sensor(points)
    normal = (straight - view.centre_px) / camera.focal_px
    inner = np.array([[camera.focal_px, 0, view.centre_px[0]], [0, camera.focal_px, view.centre_px[1]], [0, 0, 1]])
    ahead, lens = np.column_stack([normal, np.ones(len(normal))]), np.array([camera.k1, 0, 0, 0.0])
    projected, _ = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), inner, lens)
    # float64 throughout
    np.testing.assert_allclose(view.to_sensor(points), projected[:, 0], atol=1e-9)


def test_vendors_own_transmission_is_met():
    # an SC660 file stores 0.993943155 for 1 m; its temperature and humidity are 20 degC and 50 %
    assert air_transmission(1.0, 20.0, 0.5) == pytest.approx(0.993943155, abs=1e-7)


def test_counts_give_back_the_tables_temperature():
    truth = twin(**QUIET)
    renderer = Renderer(truth)
    counts = renderer.render(11)
    rows, columns = np.nonzero(renderer.scene(0.0, False).table == 1.0)
    points = renderer.view.to_plan(np.column_stack([columns, rows]))
    measured = temperature_by_hand(counts[rows, columns].astype(float), truth.recipe.camera)
    time_s = truth.session.frame_s[[11]]
    some = np.random.default_rng(3).choice(len(points), 300, replace=False)
    true = np.array([truth.temperature(time_s, points[[k], 0], points[[k], 1])[0, 0, 0] for k in some])
    # half a count is 3 mK; linear interpolation of the 1 mm field adds well under 1 mK
    assert np.abs(measured[some] - true).max() < 4e-3
    assert abs(np.mean(measured[some] - true)) < 0.5e-3


def test_noise_is_the_netd_and_differs_between_frames():
    truth = twin(netd_K=0.05)
    renderer = Renderer(truth)
    first, second = renderer.render(0).astype(float), renderer.render(0).astype(float)
    kelvin_per_count = 1.0 / float(counts_of(25.5) - counts_of(24.5))
    # 307,200 pixels: 0.2 %; rounding to whole counts adds 0.1 %
    assert (first - second).std() * kelvin_per_count / np.sqrt(2) == pytest.approx(0.05, rel=0.01)


def test_discs_lie_where_the_view_says_and_cover_their_area():
    renderer = Renderer(twin(**QUIET))
    disc = renderer.scene(0.0, False).disc
    plan = BASE.plan
    for point in fiducial_points(plan):
        column, row = renderer.view.to_sensor(point[None])[0]
        top, left = int(row) - 14, int(column) - 14
        part = disc[top : top + 30, left : left + 30]
        rows, columns = np.mgrid[top : top + 30, left : left + 30]
        centroid = np.array([(part * columns).sum(), (part * rows).sum()]) / part.sum()
        # perspective moves an ellipse's centroid from the image of the centre by less than 0.03 px here
        np.testing.assert_allclose(centroid, [column, row], atol=0.03)
        beside = renderer.view.to_sensor(point + np.array([[0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]]))
        area = abs(np.linalg.det(np.stack([beside[0] - beside[1], beside[2] - beside[3]])))
        assert part.sum() == pytest.approx(area * np.pi * plan.fiducial_diameter_mm**2 / 4, rel=0.01)


def test_discs_mirror_the_surroundings():
    truth = twin(**QUIET)
    renderer = Renderer(truth)
    counts = renderer.render(11)
    column, row = np.rint(renderer.view.to_sensor(fiducial_points(BASE.plan)[:1])[0]).astype(int)
    measured = temperature_by_hand(np.array(float(counts[row, column])), truth.recipe.camera)
    table = truth.temperature(truth.session.frame_s[[11]], np.array([40.0]), np.array([18.0]))[0, 0, 0]
    mirrored = 0.15 * table + 0.85 * 22.0
    # radiances, not temperatures, mix: over 2 K that is worth 0.03 K; the paint's own emissivity is assumed for the disc
    assert measured == pytest.approx(mirrored, abs=0.08)


def test_table_moves_through_the_view_and_its_field_with_it():
    truth = simulate(BASE.vary(camera={"table": "moving", "frame_interval_s": 7.0} | QUIET))
    renderer = Renderer(truth)
    number = int(np.argmin(np.abs(truth.frames["table_position"].values - 100.0)))
    position = float(truth.frames["table_position"][number])
    assert position > 50.0
    moved = fiducial_points(BASE.plan)[5] - np.array(BASE.plan.direction) * position
    column, row = renderer.view.to_sensor(moved[None])[0]
    disc = renderer.scene(position, False).disc
    assert disc[round(row), round(column)] == 1.0
    assert renderer.scene(0.0, False).disc[round(row), round(column)] == 0.0


def test_knock_moves_everything_from_its_cycle_on():
    truth = twin(knock_cycle=5, knock_px=(3.0, -2.0), **QUIET)
    assert truth.frames["knocked"].values.tolist() == [0] * 4 + [1] * 8
    renderer = Renderer(truth)
    before, after = renderer.scene(0.0, False).disc, renderer.scene(0.0, True).disc
    np.testing.assert_allclose(np.roll(before, (-2, 3), axis=(0, 1)), after, atol=1e-3)


def test_camera_offset_lifts_every_pixel():
    plain = Renderer(twin(**QUIET)).render(11).astype(float)
    effect = EffectRecipe("camera_offset", amplitude_K=0.5, parameters={"at_cycle": 6})
    offset = simulate(BASE.vary(camera=QUIET, effect=(effect,)))
    lifted = Renderer(offset).render(11).astype(float)
    # half a count of rounding in either frame
    np.testing.assert_allclose(lifted - plain, 0.5 * float(counts_of(25.5) - counts_of(24.5)), atol=1.0)
    assert np.array_equal(Renderer(offset).render(2), Renderer(twin(**QUIET)).render(2))


def test_reflected_source_shows_at_its_spot_by_what_the_paint_mirrors():
    spot = {"x_mm": 300.0, "y_mm": 110.0, "spread_mm": 30.0, "follows": "constant"}
    effect = EffectRecipe("reflected_source", amplitude_K=40.0, parameters=spot)
    truth = simulate(BASE.vary(camera=QUIET, effect=(effect,)))
    column, row = np.rint(make_view(truth.recipe.camera).to_sensor(np.array([[300.0, 110.0]]))[0]).astype(int)
    extra = Renderer(truth).render(11).astype(float) - Renderer(twin(**QUIET)).render(11)
    surround = truth.recipe.camera.reflected_temperature_degC
    strength = float(truth.frames["reflected_K"][11])
    tau = air_transmission(1.76, 24.0, 0.45)
    assert strength > 30.0
    mirrored = 0.03 * float(counts_of(surround + strength) - counts_of(surround))
    assert extra[row, column] == pytest.approx(tau * mirrored, abs=1.5)
    assert np.abs(extra[:40]).max() <= 1.0


def test_flat_field_corrections_step_the_zero_at_their_interval():
    truth = simulate(BASE.vary(camera={"ffc_step_K": 0.2, "ffc_interval_min": 8.4}))
    offset = truth.frames["camera_offset_K"].values
    # 8.4 min are two cycles
    assert np.all(offset[::2] == offset[1::2])
    assert np.unique(offset).size == 6


def test_camera_reads_high_as_its_housing_warms():
    truth = simulate(BASE.vary(camera={"drift_K_per_K": 0.02}))
    warmed = truth.frames["housing"].values - np.interp(0.0, truth.session.grid_s, truth.session.air_degC)
    assert warmed[-1] > 4.0
    np.testing.assert_allclose(truth.frames["camera_offset_K"].values, 0.02 * warmed, atol=1e-12)


def test_bad_pixels_stay_where_and_as_they_are():
    renderer = Renderer(twin(bad_pixels=25))
    sound = Renderer(twin())
    first, last = renderer.render(0), renderer.render(11)
    bad = np.flatnonzero(first.ravel() != sound.render(0).ravel())
    assert 23 <= bad.size <= 25
    assert np.array_equal(first.ravel()[bad], last.ravel()[bad])


def test_burst_of_frames_is_taken_while_the_table_rests():
    truth = twin(frames_per_cycle=8, burst_interval_s=0.5)
    assert truth.frames.sizes["frame"] == 12 * 8
    assert float(abs(truth.frames["table_position"]).max()) == 0.0
    np.testing.assert_allclose(np.diff(truth.session.frame_s)[:7], 0.5)
