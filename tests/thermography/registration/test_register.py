"""Registration against scenes whose plan is known exactly: OpenCV's lens model, rendered with 16 rays per pixel."""

from dataclasses import replace

import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, FOCAL_PX, GRID, Scene
from thermography.registration.plan import Fiducial
from thermography.registration.register import Lens, RegistrationError, register, register_points


def hinted(scene, rng, error_px):
    """The discs with hints that are wrong by up to `error_px` in both directions."""
    plan = np.array([(d.x_mm, d.y_mm) for d in DISCS], float)
    places = scene.to_pixels(plan) + rng.uniform(-error_px, error_px, (len(DISCS), 2))
    return [replace(d, column_px=c, row_px=r) for d, (c, r) in zip(DISCS, places, strict=True)]


@pytest.mark.parametrize(("k1", "disc_K"), [(0.0, -4.0), (-1.2, 4.0)])
def test_plan_is_found_without_hints_at_both_contrasts(rng, k1, disc_K):
    scene = Scene(k1=k1, disc_K=disc_K)
    registration = register(scene.render(rng), DISCS, grid=GRID)
    # 0.15 mm is the aim; one pixel is 1.2 mm here and centroids err by 0.01..0.02 px.
    assert scene.registration_rms_mm(registration) < 0.05
    assert set(registration.located) | set(registration.left_out) == {disc.name for disc in DISCS}
    # What k1 means depends on the focal length; only their ratio is seen.
    ratio = registration.distortion[0] / registration.projection.focal_length_px**2
    assert ratio == pytest.approx(k1 / FOCAL_PX**2, abs=0.02 / FOCAL_PX**2)


def test_wrong_hints_do_not_matter(rng):
    scene = Scene(disc_K=-4.0)
    fiducials = hinted(scene, rng, 18)
    fiducials[3] = replace(fiducials[3], column_px=100.0, row_px=400.0)
    registration = register(scene.render(rng), fiducials, grid=GRID)
    assert scene.registration_rms_mm(registration) < 0.05
    assert "was not used" in registration.left_out["F4 (hint)"]


def test_ladder_stays_on_the_lowest_rung_that_is_enough(rng):
    straight = register(Scene(disc_K=-4.0).render(rng), DISCS, grid=GRID)
    bent = register(Scene(disc_K=-4.0, k1=-1.2).render(rng), DISCS, grid=GRID)
    assert straight.model == "homography"
    # The rendered discs are made of 16 rays per pixel, whose 0.01 px the richest rung may take for tangential distortion.
    assert bent.model.startswith("homography+k1")


def test_calibrated_lens_is_taken_as_given(rng):
    scene = Scene(disc_K=-4.0, k1=-1.2)
    lens = Lens(FOCAL_PX, (319.5, 239.5), (-1.2, 0.0, 0.0, 0.0))
    registration = register(scene.render(rng), DISCS, grid=GRID, lens=lens)
    assert registration.distortion.tolist() == [-1.2, 0, 0, 0]
    assert scene.registration_rms_mm(registration) < 0.05


def test_uncertainty_map_covers_the_true_error(rng):
    scene = Scene(disc_K=-4.0)
    image = scene.render()
    places = np.array([(20.0, 20.0), (350.0, 90.0), (680.0, 160.0), (350.0, 10.0)])
    ratios = []
    for _ in range(8):
        registration = register(image + rng.normal(0, 0.2, image.shape), hinted(scene, rng, 2), grid=GRID)
        error = np.linalg.norm(scene.to_plan(registration.to_sensor(places)) - places, axis=1)
        ratios.append(error / registration.position_u(places))
    # u states the root of the mean square error; 32 ratios that share 8 registrations give it to about 25 %.
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_low_contrast_in_one_frame_is_lifted_by_averaging(rng):
    # 0.12 K under 50 mK of noise: below what one frame locates reliably.
    flat = Scene(disc_K=-0.12, field=lambda x, y: np.full_like(x, 23.0 + 0.004 * 450 + 0.24))
    image = flat.render()
    stack = image + rng.normal(0, 0.05, (25, *image.shape))
    registration = register(stack, DISCS, grid=GRID)
    assert len(registration.located) == 12
    assert flat.registration_rms_mm(registration) < 0.1


def test_missing_duplicate_and_misplaced_fiducials_are_reported(rng):
    scene = Scene(disc_K=-4.0, discs=tuple(d for d in DISCS if d.name != "F3"))
    listed = [replace(d, x_mm=d.x_mm + 4) if d.name == "F8" else d for d in DISCS]
    registration = register(
        scene.render(rng), [*listed, replace(DISCS[0], name="F1"), replace(DISCS[1], name="F13")], grid=GRID
    )
    assert set(registration.located) == {d.name for d in DISCS} - {"F3", "F8"}
    assert "listed twice" in registration.left_out["F1 (second)"]
    assert "beside F2" in registration.left_out["F13"]
    assert "F3" in registration.left_out
    assert "check its x_mm, y_mm" in registration.left_out["F8"]
    assert scene.registration_rms_mm(registration) < 0.05


def test_symmetric_arrangement_is_refused_without_hints(rng):
    places = [(40, 20), (350, 20), (660, 20), (40, 160), (350, 160), (660, 160)]
    discs = [Fiducial(f"S{i}", x, y, 16.0) for i, (x, y) in enumerate(places)]
    image = Scene(disc_K=-4.0, discs=tuple(discs)).render(rng)
    with pytest.raises(RegistrationError, match="symmetric and fits in two ways; give column_px,row_px"):
        register(image, discs, grid=GRID)


def test_too_few_fiducials_are_refused(rng):
    image = Scene(disc_K=-4.0, discs=tuple(DISCS[:3])).render(rng)
    with pytest.raises(RegistrationError, match="only 3 disc-shaped spots are in view where 12 fiducials are listed"):
        register(image, DISCS, grid=GRID)


def test_picked_points_register_without_an_image():
    scene = Scene()
    plan = np.array([(d.x_mm, d.y_mm) for d in DISCS], float)
    picked = {d.name: tuple(p) for d, p in zip(DISCS[:8], scene.to_pixels(plan), strict=False)}
    registration = register_points(picked, DISCS, (480, 640))
    # The image of a disc's centre is not the centroid of its image, by up to 0.03 px here.
    assert scene.registration_rms_mm(registration) < 0.1
    assert registration.left_out["F9"] == "was not picked"
    pairs = [
        replace(d, column_px=picked[d.name][0], row_px=picked[d.name][1]) if d.name in picked else d for d in DISCS
    ]
    assert register_points(None, pairs, (480, 640)).located == registration.located
    with pytest.raises(RegistrationError, match="picked points G1 are not in the list of fiducials"):
        register_points({"G1": (1.0, 1.0)}, DISCS, (480, 640))


def test_points_without_discs_register_by_command_and_a_wrong_pick_is_named(rng):
    scene = Scene()
    plan = np.array([(d.x_mm, d.y_mm) for d in DISCS], float)
    places = scene.to_pixels(plan) + rng.normal(0, 0.5, plan.shape)
    points = [Fiducial(d.name, d.x_mm, d.y_mm, 0.0, c, r) for d, (c, r) in zip(DISCS, places, strict=True)]
    points[2] = replace(points[2], column_px=points[2].column_px + 40)
    registration = register(np.full((480, 640), 22.0), points, grid=GRID)
    assert set(registration.left_out) == {"F3"}
    assert scene.registration_rms_mm(registration) < 2 * np.sqrt(np.mean(registration.position_u(plan) ** 2))
    with pytest.raises(RegistrationError, match="picked points contradict one another"):
        register_points({points[i].name: points[i].hint_px for i in (0, 2, 4, 5, 9)}, points, (480, 640))


def test_four_discs_determine_the_plan_and_check_nothing(rng):
    scene = Scene(disc_K=-4.0, k1=-0.3)
    corners = [disc for disc in hinted(scene, rng, 5) if disc.name in ("F1", "F5", "F6", "F10")]
    registration = register(scene.render(rng), corners, grid=GRID)
    assert registration.unchecked == ("F1", "F5", "F6", "F10")
    assert np.isnan(registration.rms_mm)
    # The lens distorts by up to 0.9 mm between the corners, which nothing but the spread among lenses tells.
    u_mm = np.sqrt(np.mean(registration.position_u(GRID.centres_mm) ** 2))
    assert scene.registration_rms_mm(registration) < 2 * u_mm
    assert u_mm > 0.3


def test_the_uncertainty_of_four_discs_contains_a_place_that_is_wrong_by_two_diameters(rng):
    scene = Scene(disc_K=-4.0)
    corners = [disc for disc in hinted(scene, rng, 5) if disc.name in ("F1", "F5", "F6", "F10")]
    corners[1] = replace(corners[1], x_mm=corners[1].x_mm - 2.0 * corners[1].diameter_mm)
    registration = register(scene.render(rng), corners, grid=GRID)
    u_mm = np.sqrt(np.mean(registration.position_u(GRID.centres_mm) ** 2))
    # Two diameters are 3.5 standard uncertainties of that place; the other three places take their part of the sum.
    assert scene.registration_rms_mm(registration) < 2.5 * u_mm


def test_three_wrong_places_of_twelve_are_named_and_do_not_bend_the_others(rng):
    scene = Scene(disc_K=-4.0)
    listed = [replace(d, x_mm=d.x_mm + 4, y_mm=d.y_mm - 3) if d.name in ("F2", "F6", "F12") else d for d in DISCS]
    registration = register(scene.render(rng), listed, grid=GRID)
    assert set(registration.left_out) == {"F2", "F6", "F12"}
    assert "misplaced by 5.0" in registration.left_out["F6"]
    assert scene.registration_rms_mm(registration) < 0.05


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_diameters_that_contradict_the_places_are_refused(rng, factor):
    scene = Scene(disc_K=-4.0)
    listed = [replace(d, diameter_mm=factor * d.diameter_mm) for d in hinted(scene, rng, 5)]
    with pytest.raises(RegistrationError, match="places and diameters of the fiducials contradict each other"):
        register(scene.render(rng), listed, grid=GRID)


def test_a_mirrored_plan_is_recognised(rng):
    scene = Scene(disc_K=-4.0)
    listed = [replace(d, y_mm=180 - d.y_mm) for d in DISCS]
    assert register(scene.render(rng), listed, grid=GRID).mirrored
    assert not register(scene.render(rng), DISCS, grid=GRID).mirrored


def test_a_lens_of_other_frames_is_refused(rng):
    lens = Lens(FOCAL_PX, (159.5, 119.5), (-1.2, 0.0, 0.0, 0.0), (320, 240))
    with pytest.raises(RegistrationError, match="calibrated with frames of 320 x 240 pixels, these have 640 x 480"):
        register(Scene(disc_K=-4.0).render(rng), DISCS, grid=GRID, lens=lens)


def test_points_on_a_line_are_refused():
    line = [Fiducial(f"L{i}", 50.0 + 100 * i, 90.0, 16.0) for i in range(5)]
    with pytest.raises(RegistrationError, match="lie on a line or on one spot; spread at least four"):
        register_points({d.name: (d.x_mm, 200.0) for d in line}, line, (480, 640))


@pytest.mark.parametrize("shape", [(), (5,), (2, 2, 48, 64), (0, 64)])
def test_what_is_neither_a_frame_nor_a_stack_is_refused(shape):
    with pytest.raises(RegistrationError, match=r"temperature has shape .*; give one frame"):
        register(np.zeros(shape), DISCS, grid=GRID)


@pytest.mark.parametrize("fiducials", [[], DISCS[:3], [*DISCS[:3], DISCS[0]]])
def test_a_list_of_fewer_than_four_discs_is_refused(fiducials):
    count = min(len(fiducials), 3)
    with pytest.raises(
        RegistrationError, match=f"fiducials lists {count} different discs; a plan is located by at least 4"
    ):
        register(np.zeros((48, 64)), fiducials, grid=GRID)
