"""Registration against scenes whose plan is known exactly: matching, wrong places, the evidence for a plan, and refusals."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, FOCAL_PX, GRID, Scene, registered
from thermography.registration.discs import SPOT_U_PX, LocatedDisc
from thermography.registration.plan import Fiducial
from thermography.registration.projection import DiscObservations, Projection
from thermography.registration.register import (
    Lens,
    MatchError,
    RegistrationError,
    area_ratio,
    chance_of_arrangement,
    chance_of_hints,
    contradicted_hints,
    exact_homographies,
    fit_agreeing,
    match_by_arrangement,
    match_by_hints,
    refuse_chance,
    refuse_picks,
    refuse_scatter,
    refuse_sizes,
    register,
    register_points,
    size_contradiction,
    spread_quadruples,
)

PLAN = np.array([(disc.x_mm, disc.y_mm) for disc in DISCS], float)
pytestmark = pytest.mark.long


def hinted(scene, rng, error_px):
    """The discs with hints that are wrong by up to `error_px` in both directions."""
    places = scene.to_pixels(PLAN) + rng.uniform(-error_px, error_px, (len(DISCS), 2))
    return [replace(d, column_px=c, row_px=r) for d, (c, r) in zip(DISCS, places, strict=True)]


@pytest.mark.parametrize(("k1", "disc_K"), [pytest.param(0.0, -4.0, marks=pytest.mark.slow), (-1.2, 4.0)])
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
    straight, bent = (
        register(scene.render(rng), hinted(scene, rng, 2), grid=GRID)
        for scene in (Scene(disc_K=-4.0), Scene(disc_K=-4.0, k1=-1.2))
    )
    assert straight.model == "homography"
    # The rendered discs are made of 16 rays per pixel, whose 0.01 px the richest rung may take for tangential distortion.
    assert bent.model.startswith("homography+k1")


def test_calibrated_lens_is_taken_as_given(rng):
    scene = Scene(disc_K=-4.0, k1=-1.2)
    lens = Lens(FOCAL_PX, (319.5, 239.5), (-1.2, 0.0, 0.0, 0.0))
    registration = register(scene.render(rng), hinted(scene, rng, 2), grid=GRID, lens=lens)
    assert registration.distortion.tolist() == [-1.2, 0, 0, 0]
    assert scene.registration_rms_mm(registration) < 0.05


def test_uncertainty_map_covers_the_true_error(rng):
    scene = Scene(disc_K=-4.0)
    image = scene.render()
    places = np.array([(20.0, 20.0), (350.0, 90.0), (680.0, 160.0), (350.0, 10.0)])
    ratios = []
    for _ in range(2):
        registration = register(image + rng.normal(0, 0.2, image.shape), hinted(scene, rng, 2), grid=GRID)
        error = np.linalg.norm(scene.to_plan(registration.to_sensor(places)) - places, axis=1)
        ratios.append(error / registration.position_u(places))
    # u states the root of the mean square error; 8 ratios that share 2 registrations give it to about 50 % (many: tests/soak).
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.8


def test_low_contrast_in_one_frame_is_lifted_by_averaging(rng):
    # 0.12 K under 50 mK of noise: below what one frame locates reliably.
    flat = Scene(disc_K=-0.12, field=lambda x, y: np.full_like(x, 23.0 + 0.004 * 450 + 0.24))
    image = flat.render()
    stack = image + rng.normal(0, 0.05, (25, *image.shape))
    registration = register(stack, hinted(flat, rng, 2), grid=GRID)
    assert len(registration.located) == 12
    assert flat.registration_rms_mm(registration) < 0.1


def test_missing_duplicate_and_misplaced_fiducials_are_reported(rng):
    scene = Scene(disc_K=-4.0, discs=tuple(d for d in DISCS if d.name != "F3"))
    listed = [replace(d, x_mm=d.x_mm + 4) if d.name == "F8" else d for d in DISCS]
    listed += [replace(DISCS[0], name="F1"), replace(DISCS[1], name="F13")]
    registration = register(scene.render(rng), listed, grid=GRID)
    assert set(registration.located) == {d.name for d in DISCS} - {"F3", "F8"}
    assert "listed twice" in registration.left_out["F1 (second)"]
    assert "also as F2" in registration.left_out["F13"]
    assert "F3" in registration.left_out
    assert "check its x_mm, y_mm" in registration.left_out["F8"]
    assert scene.registration_rms_mm(registration) < 0.05


def test_too_few_fiducials_are_refused(rng):
    image = Scene(disc_K=-4.0, discs=tuple(DISCS[:3])).render(rng)
    with pytest.raises(RegistrationError, match="only 3 disc-shaped spots are in view where 12 fiducials are listed"):
        register(image, DISCS, grid=GRID)


def test_picked_points_register_without_an_image():
    scene = Scene()
    picked = {d.name: tuple(p) for d, p in zip(DISCS[:8], scene.to_pixels(PLAN), strict=False)}
    registration = register_points(picked, DISCS, (480, 640))
    # The image of a disc's centre is not the centroid of its image, by up to 0.03 px here.
    assert scene.registration_rms_mm(registration) < 0.1
    assert registration.left_out["F9"] == "was not picked"
    both = [replace(d, column_px=picked[d.name][0], row_px=picked[d.name][1]) if d.name in picked else d for d in DISCS]
    assert register_points(None, both, (480, 640)).located == registration.located
    with pytest.raises(RegistrationError, match="picked points G1 are not in the list of fiducials"):
        register_points({"G1": (1.0, 1.0)}, DISCS, (480, 640))


def test_points_without_discs_register_by_command_and_a_wrong_pick_is_named(rng):
    scene = Scene()
    places = scene.to_pixels(PLAN) + rng.normal(0, 0.5, PLAN.shape)
    points = [Fiducial(d.name, d.x_mm, d.y_mm, 0.0, c, r) for d, (c, r) in zip(DISCS, places, strict=True)]
    points[2] = replace(points[2], column_px=points[2].column_px + 40)
    registration = register(np.full((480, 640), 22.0), points, grid=GRID)
    assert set(registration.left_out) == {"F3"}
    assert scene.registration_rms_mm(registration) < 2 * np.sqrt(np.mean(registration.position_u(PLAN) ** 2))
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


def test_diameters_that_contradict_the_places_are_refused(rng):
    scene = Scene(disc_K=-4.0)
    listed = [replace(d, diameter_mm=2.0 * d.diameter_mm) for d in hinted(scene, rng, 5)]
    with pytest.raises(RegistrationError, match="places and diameters of the fiducials contradict each other"):
        register(scene.render(rng), listed, grid=GRID)


def test_a_mirrored_plan_is_recognised(rng):
    scene = Scene(disc_K=-4.0)
    listed = [replace(d, y_mm=180 - d.y_mm) for d in DISCS]
    assert register(scene.render(rng), listed, grid=GRID).mirrored
    assert not registered(scene).mirrored


def test_a_lens_of_other_frames_is_refused(rng):
    lens = Lens(FOCAL_PX, (159.5, 119.5), (-1.2, 0.0, 0.0, 0.0), (320, 240))
    with pytest.raises(RegistrationError, match="calibrated with frames of 320 x 240 pixels, these have 640 x 480"):
        register(Scene(disc_K=-4.0).render(rng), DISCS, grid=GRID, lens=lens)


def test_points_on_a_line_are_refused():
    line = [Fiducial(f"L{i}", 50.0 + 100 * i, 90.0, 16.0) for i in range(5)]
    with pytest.raises(RegistrationError, match="are collinear or coincide; spread at least four"):
        register_points({d.name: (d.x_mm, 200.0) for d in line}, line, (480, 640))


@pytest.mark.parametrize("shape", [(), (5,), (2, 2, 48, 64), (0, 64)])
def test_what_is_neither_a_frame_nor_a_stack_is_refused(shape):
    with pytest.raises(RegistrationError, match=r"temperature has shape .*; give one frame"):
        register(np.zeros(shape), DISCS, grid=GRID)


@pytest.mark.parametrize("fiducials", [[], DISCS[:3], [*DISCS[:3], DISCS[0]]])
def test_a_list_of_fewer_than_four_discs_is_refused(fiducials):
    count = min(len(fiducials), 3)
    with pytest.raises(RegistrationError, match=f"fiducials lists {count} different discs; a plan needs at least 4"):
        register(np.zeros((48, 64)), fiducials, grid=GRID)


SCENE = Scene()


def spots_of(discs):
    """Spots where the scene shows the discs, as large as it shows them."""
    spots = {}
    for disc in discs:
        angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
        rim = np.column_stack([disc.x_mm + 8 * np.cos(angle), disc.y_mm + 8 * np.sin(angle)])
        (column, row), outline = SCENE.to_pixels([(disc.x_mm, disc.y_mm)])[0], SCENE.to_pixels(rim)
        a, b = outline, np.roll(outline, -1, axis=0)
        area = 0.5 * abs((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
        spots[disc.name] = LocatedDisc(float(column), float(row), SPOT_U_PX, float(area), -3.0)
    return spots


def shuffled(spots, rng):
    spots = list(spots)
    rng.shuffle(spots)
    return spots


def test_arrangement_alone_names_every_spot(rng):
    spots = spots_of(DISCS)
    strays = [LocatedDisc(50.0, 400.0, SPOT_U_PX, 120.0, 2.0), LocatedDisc(400.0, 200.0, SPOT_U_PX, 900.0, -2.0)]
    matched, hypotheses = match_by_arrangement(shuffled([*spots.values(), *strays], rng), DISCS, shape=SCENE.shape)
    assert matched == spots
    assert hypotheses > 0


def test_hints_name_the_spots_though_one_is_far_off(rng):
    spots = spots_of(DISCS)
    hinted = [
        replace(disc, column_px=spots[disc.name].column_px + 8, row_px=spots[disc.name].row_px - 6) for disc in DISCS
    ]
    hinted[4] = replace(hinted[4], column_px=600.0, row_px=20.0)
    assert match_by_hints(shuffled(spots.values(), rng), hinted) == spots


def test_too_few_hints_and_symmetric_or_small_arrangements_are_refused():
    assert match_by_hints(list(spots_of(DISCS).values()), DISCS) == {}
    places = [(40, 20), (350, 20), (660, 20), (40, 160), (350, 160), (660, 160)]
    symmetric = [Fiducial(f"S{i}", x, y, 16.0) for i, (x, y) in enumerate(places)]
    with pytest.raises(MatchError, match="symmetric and fits in two ways; give column_px,row_px for at least 4"):
        match_by_arrangement(list(spots_of(symmetric).values()), symmetric, shape=SCENE.shape)
    with pytest.raises(MatchError, match=r"5 fiducials cannot be told apart by arrangement, which needs 6"):
        match_by_arrangement(list(spots_of(DISCS[:5]).values()), DISCS[:5], shape=SCENE.shape)


SQUARE = np.array([(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)])


def test_the_widest_quadruple_comes_first_and_points_on_a_line_make_none():
    points = np.concatenate([[(50.0, 50.0), (55.0, 52.0)], SQUARE])
    assert set(spread_quadruples(points)[0].tolist()) == {2, 3, 4, 5}
    assert len(spread_quadruples(points, limit=3)) == 3
    line = np.column_stack([np.arange(6.0), np.zeros(6)])
    assert spread_quadruples(line).shape == (0, 4)


def test_of_many_points_a_part_is_compared_always_the_same(rng):
    points = rng.uniform(0, 500, (60, 2))
    first = spread_quadruples(points)
    assert first.shape == (500, 4)
    assert all(len(set(quad)) == 4 for quad in first.tolist())
    np.testing.assert_array_equal(first, spread_quadruples(points))


def test_four_points_are_mapped_exactly_as_by_opencv(rng):
    plan = rng.uniform(0, 500, (20, 4, 2))
    image = plan[:, ::-1] * 0.8 + rng.uniform(-20, 20, (20, 4, 2))
    for matrix, one, other in zip(exact_homographies(plan, image), plan, image, strict=True):
        np.testing.assert_allclose(cv2.perspectiveTransform(one[None], matrix)[0], other, atol=1e-6)
    shared = exact_homographies(plan[:1], image)
    np.testing.assert_allclose(cv2.perspectiveTransform(plan[:1], shared[7])[0], image[7], atol=1e-6)


IDEAL = Projection(np.eye(3), np.zeros(4), 640.0, (319.5, 239.5))


def observed(rng, *, k1=-1.2, places_u_mm=0.0, plan=PLAN):
    """Centroids of the listed discs with 0.02 px of noise; their true places differ from the list by `places_u_mm`."""
    true = plan + rng.normal(0, 1, plan.shape) * places_u_mm
    pixels = Scene(k1=k1).to_pixels(true) + rng.normal(0, 0.02, plan.shape)
    return DiscObservations(pixels, plan.copy(), np.full(len(plan), 8.0), np.full(len(plan), 0.02))


@pytest.mark.parametrize(("count", "error_mm"), [(1, 0.9), (2, 3.0), (3, 5.0), (3, 60.0)])
def test_wrong_places_are_told_from_right_ones(rng, count, error_mm):
    for _ in range(4):
        observations = observed(rng)
        wrong = rng.permutation(12)[:count]
        angle = rng.uniform(0, 2 * np.pi, count)
        observations.centres_mm[wrong] += error_mm * np.column_stack([np.cos(angle), np.sin(angle)])
        fit, agreeing = fit_agreeing(observations, IDEAL, calibrated=False)
        assert set(np.flatnonzero(~agreeing)) == set(wrong)
        np.testing.assert_allclose(fit.projection.to_sensor(PLAN[agreeing]), observations.points_px[agreeing], atol=0.3)


@pytest.mark.parametrize("places_u_mm", [0.0, 0.2])
def test_right_places_are_not_called_wrong(rng, places_u_mm):
    # The test is meant to lose a disc in one list of a thousand; of 12 more than one would be a wrong scale.
    lists = (observed(rng, places_u_mm=places_u_mm) for _ in range(12))
    lost = sum(not fit_agreeing(each, IDEAL, calibrated=False)[1].all() for each in lists)
    assert lost <= 1


def test_six_right_places_are_all_kept(rng):
    # As six discs of a coarse camera lie, three of them nearly on a line: every five of them leave hardly a degree of freedom.
    plan = np.array([(60, 30), (350, 32), (640, 35), (60, 145), (350, 150), (640, 148)], float)
    lost = sum(not fit_agreeing(observed(rng, plan=plan), IDEAL, calibrated=False)[1].all() for _ in range(20))
    assert lost <= 1


def test_five_discs_cannot_be_told_apart(rng):
    observations = observed(rng, plan=PLAN[[0, 4, 5, 9, 10]])
    observations.centres_mm[0] += (20.0, 0.0)
    assert fit_agreeing(observations, IDEAL, calibrated=False)[1].all()


def test_a_given_lens_is_kept(rng):
    lens = Projection(np.eye(3), np.array([-1.2, 0, 0, 0]), 1530.0, (319.5, 239.5))
    fit, agreeing = fit_agreeing(observed(rng), lens, calibrated=True)
    assert (fit.projection.distortion[0], fit.coefficients, agreeing.all()) == (-1.2, 0, True)


PROJECTION = Projection(Scene().plan_to_pixel, np.zeros(4), 640.0, (319.5, 239.5))
AREA_PX = 480.0 * 640


def located(discs=DISCS, ratio=1.0):
    """The first discs where they are, with `ratio` times their area."""
    places = PROJECTION.to_sensor(PLAN[: len(discs)])
    areas = np.abs(np.linalg.det(PROJECTION.jacobian(PLAN[: len(discs)]))) * np.pi * 64 * ratio
    return {
        disc.name: LocatedDisc(float(c), float(r), 0.02, float(a), -3.0)
        for disc, (c, r), a in zip(discs, places, areas, strict=True)
    }


def as_spots(discs):
    return [replace(disc, u_px=SPOT_U_PX) for disc in discs.values()]


def hinted_at(places, errors):
    """The first discs with hints that are wrong by some columns."""
    return [
        replace(disc, column_px=place.column_px + error, row_px=place.row_px)
        for disc, place, error in zip(DISCS, places.values(), errors, strict=False)
    ]


def test_chance_of_hints_is_the_rate_at_which_scattered_spots_do_as_well(rng):
    hints, spots, reach, runs = rng.uniform(100, 380, (8, 2)), 12, 40.0, 4000
    hits = 0
    for _ in range(runs):
        scattered = rng.uniform(0, (640, 480), (spots, 2))
        nearest = np.linalg.norm(hints[:, None] - scattered, axis=-1).min(axis=1)
        hits += int((nearest < reach).sum() >= 4)
    expected = chance_of_hints(np.full(4, reach), 8, spots, area_px=AREA_PX)
    # An expectation over choices bounds the rate, and by no more than the choices overlap.
    assert hits / runs <= 1.1 * expected
    assert expected < 20 * hits / runs


def test_chance_of_an_arrangement_falls_with_discs_and_rises_with_misses_and_trials():
    chance = lambda missed, hypotheses=1000, k=0: chance_of_arrangement(  # noqa: E731
        12, 15, np.array(missed), hypotheses=hypotheses, coefficients=k, area_px=AREA_PX
    )
    assert chance([0.05] * 12) < 1e-30
    assert chance([0.05] * 6) < chance([2.0] * 6) < chance([2.0] * 6, 10_000)
    assert chance([0.05] * 5, k=1) == chance([0.05] * 4) == np.inf
    assert chance([0.5] * 7, k=1) > chance([0.5] * 7)


def test_what_chance_explains_is_refused_and_near_hints_prove():
    few = located(DISCS[:6])
    with pytest.raises(RegistrationError, match=r"6 of 12 fiducials fit the spots in view, and chance alone would"):
        refuse_chance(few, DISCS, as_spots(few), np.full(6, 6.0), hypotheses=5000, coefficients=1, shape=(480, 640))
    every = located()
    refuse_chance(every, DISCS, as_spots(every), np.full(12, 0.05), hypotheses=5000, coefficients=1, shape=(480, 640))
    four = located(DISCS[:4])
    arguments = {"hypotheses": 1, "coefficients": 1, "shape": (480, 640)}
    refuse_chance(four, hinted_at(four, [8.0] * 4), as_spots(four), np.full(4, np.nan), **arguments)
    with pytest.raises(RegistrationError, match=r"4 of 4 fiducials fit .*; 4 of their 4 hints contradict them"):
        refuse_chance(four, hinted_at(four, [90.0] * 4), as_spots(four) * 6, np.full(4, np.nan), **arguments)


def test_places_diameters_and_hints_that_contradict_are_named():
    missed = {disc.name: 0.1 for disc in DISCS} | {"F7": 9.0}
    refuse_scatter(1.5, missed, DISCS)
    with pytest.raises(RegistrationError, match=r"by 1\.7 mm \(standard deviation; up to 1\.6 mm.*F7 is missed by the"):
        refuse_scatter(1.7, missed, DISCS)
    refuse_picks(2.0, missed)
    with pytest.raises(RegistrationError, match=r"picked points contradict one another by 4\.0 px.*F7"):
        refuse_picks(4.0, missed)
    assert area_ratio(located(ratio=1.2), DISCS, PROJECTION) == pytest.approx(1.2, rel=0.01)
    assert np.isnan(area_ratio({}, [Fiducial("P1", 1.0, 2.0, 0.0, 3.0, 4.0)], PROJECTION))
    refuse_sizes(1.2, DISCS)
    with pytest.raises(RegistrationError, match=r"the discs in view measure 11\.3 mm, diameter_mm says 16 mm"):
        refuse_sizes(0.5, DISCS)
    places = located(ratio=0.25)
    hinted = hinted_at(places, [0.0] * 12)
    blurred = [replace(spot, area_px=spot.area_px + 4.9) for spot in as_spots(places)]
    assert "measure 8.0 mm, diameter_mm says 16 mm" in size_contradiction(blurred, hinted)
    assert size_contradiction(as_spots(located()), hinted) == ""
    assert size_contradiction(as_spots(places), DISCS) == ""
    places = located(DISCS[:2])
    wrong = contradicted_hints(places, hinted_at(places, [10.0, 70.0]))
    assert list(wrong) == ["F2 (hint)"]
    assert "is 70 px from the disc; it was not used" in wrong["F2 (hint)"]
    # Hints of another view are all off alike; those that point at other discs exchange the names.
    places = located()
    (alike,) = contradicted_hints(places, hinted_at(places, [60.0, 55.0, 62.0, 60.0, 58.0, 60.0])).items()
    assert alike[0] == "column_px, row_px" and "by the same (+60, +0) px" in alike[1]
    spacing_px = next(p for n, p in places.items() if n == "F2").column_px - places["F1"].column_px
    assert list(contradicted_hints(places, hinted_at(places, [spacing_px] * 4))) == [
        f"F{n} (hint)" for n in (1, 2, 3, 4)
    ]


@pytest.mark.parametrize("u_mm", [0.0, 2.0])
def test_a_scale_of_the_list_is_in_the_uncertainty_where_that_of_the_list_is_stated(rng, u_mm):
    scene = Scene(disc_K=-4.0)
    listed = [replace(disc, x_mm=1.01 * disc.x_mm, y_mm=1.01 * disc.y_mm, u_mm=u_mm) for disc in hinted(scene, rng, 5)]
    registration = register(scene.render(rng), listed, grid=GRID)
    u = np.sqrt(np.mean(registration.position_u(GRID.centres_mm) ** 2))
    assert bool(scene.registration_rms_mm(registration) < 2 * u) is bool(u_mm)
    # Three edge spreads, and two pixels at least.
    assert registration.margin_px == max(2.0, 3 * registration.optics.spread_px)


def test_five_discs_whose_places_are_right_are_located_within_an_uncertainty_below_a_diameter(rng):
    scene = Scene(disc_K=-4.0)
    five = [disc for disc in hinted(scene, rng, 5) if disc.name in ("F1", "F3", "F5", "F6", "F10")]
    registration = register(scene.render(rng), five, grid=GRID)
    u = np.sqrt(np.mean(registration.position_u(GRID.centres_mm) ** 2))
    assert scene.registration_rms_mm(registration) < 2.5 * u < 5.0
    assert registration.unchecked
