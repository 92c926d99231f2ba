"""Discs and markers in a thermogram."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, GRID, Scene
from thermography.registration.discs import (
    DICTIONARY,
    LocatedDisc,
    MarkerError,
    detect_discs,
    detect_markers,
    identify_plan,
    locate_disc,
)
from thermography.registration.plan import Fiducial, PlanGrid
from thermography.registration.register import register

pytestmark = pytest.mark.long

#: 2 px/mm, plan and sensor parallel.
JACOBIAN = 2.0 * np.eye(2)
SMALL_GRID = PlanGrid(100, 60, 5)


def draw(centre_px, radius_px, *, disc_K=-3.0, slope=0.0, shape=(120, 200)):
    """A frame at 22 degC with a disc, every pixel the mean of 8 x 8 points; the table rises by `slope` K/px along the columns."""
    steps = (np.arange(8) + 0.5) / 8 - 0.5
    column = (np.arange(shape[1])[:, None] + steps).ravel()
    row = (np.arange(shape[0])[:, None] + steps).ravel()
    inside = np.hypot(column - centre_px[0], row[:, None] - centre_px[1]) < radius_px
    fine = np.where(inside, 22.0 + disc_K, 22.0 + slope * (column - centre_px[0]))
    return fine.reshape(shape[0], 8, shape[1], 8).mean(axis=(1, 3))


@pytest.mark.parametrize("disc_K", [-3.0, 3.0])
@pytest.mark.parametrize("slope", [0.0, 0.02])
def test_centroid_is_exact_at_both_contrasts_and_on_a_gradient(disc_K, slope):
    disc, centre = Fiducial("F1", 50.13, 30.32, 16.0), np.array([100.26, 60.64])
    image, start = draw(centre, 16.0, disc_K=disc_K, slope=slope), centre + np.array([1.5, -1.0])
    located = locate_disc(image, disc, SMALL_GRID, start, JACOBIAN)
    assert isinstance(located, LocatedDisc)
    assert np.hypot(located.column_px - centre[0], located.row_px - centre[1]) < 0.01
    assert located.contrast_K == pytest.approx(disc_K, abs=0.01)
    assert located.area_px == pytest.approx(np.pi * 16**2, rel=0.01)


def test_stated_uncertainty_is_the_scatter_of_the_centroid(rng):
    disc, centre = Fiducial("F1", 50.0, 30.0, 16.0), np.array([100.0, 60.0])
    image = draw(centre, 16.0)
    noisy = (image + rng.normal(0, 0.3, image.shape) for _ in range(40))
    located = [locate_disc(each, disc, SMALL_GRID, centre, JACOBIAN) for each in noisy]
    scatter = np.std([(place.column_px, place.row_px) for place in located], axis=0).mean()
    # 80 values give their standard deviation to 8 %; the planes under and around the disc share the noise.
    assert np.mean([place.u_px for place in located]) == pytest.approx(scatter, rel=0.3)


@pytest.mark.parametrize("blur_px", [0.6, 2.5])
def test_the_blur_is_measured_and_moves_no_centroid_nor_does_an_edge_of_the_table_beside_the_disc(blur_px):
    disc, centre = Fiducial("F1", 50.13, 9.6, 16.0), np.array([100.26, 19.2])
    image = draw(centre, 16.0)
    # The table ends 1.6 mm from the disc, and what lies beyond is warmer.
    image = cv2.GaussianBlur(np.pad(image, ((20, 0), (0, 0)), constant_values=27.0), (0, 0), blur_px)
    located = locate_disc(image, disc, SMALL_GRID, centre + np.array([0.4, 20.3]), JACOBIAN)
    assert isinstance(located, LocatedDisc)
    assert (located.column_px, located.row_px) == pytest.approx((100.26, 39.2), abs=0.02)
    # A pixel is a square, of variance 1/12; the blur was drawn in whole pixels, too.
    assert located.spread_px == pytest.approx(np.hypot(blur_px, 12**-0.5), rel=0.05)
    assert located.area_px == pytest.approx(np.pi * 16**2, rel=0.01)


def test_reasons_why_a_disc_is_not_located(rng):
    disc, centre = Fiducial("F1", 50.0, 30.0, 16.0), np.array([100.0, 60.0])
    plain = 22.0 + rng.normal(0, 0.05, (120, 200))
    assert locate_disc(plain, disc, SMALL_GRID, centre, JACOBIAN).startswith("has no contrast (")
    for place in ((5.0, 60.0), (np.nan, 60.0), (np.inf, 60.0), (1e300, 60.0)):
        assert locate_disc(plain, disc, SMALL_GRID, np.array(place), JACOBIAN) == "lies at the edge of the frame"
    off = locate_disc(draw(centre, 16.0), disc, SMALL_GRID, centre + np.array([12.0, 0.0]), JACOBIAN)
    assert off == "no disc within 3.0 px of where it should be"
    tiny = Fiducial("F1", 50.0, 30.0, 1.0)
    reason = locate_disc(plain, tiny, SMALL_GRID, centre, JACOBIAN)
    assert reason == "is too small in the frame or too near the plan's edge"


def test_discs_are_detected_where_and_as_large_as_they_are_and_bars_are_not(rng):
    image = draw((60.0, 40.0), 8.0, disc_K=-3.0) + draw((140.0, 80.0), 12.0, disc_K=2.0) - 22.0
    image[10:16, 120:160] += 4.0
    spots = detect_discs(image + rng.normal(0, 0.05, image.shape))
    cold, warm = spots[:2]
    # 40 px x 6 px: too oblique for a disc.
    assert not any(abs(s.column_px - 140) < 20 and abs(s.row_px - 13) < 3 for s in spots)
    assert (cold.column_px, cold.row_px) == pytest.approx((60, 40), abs=0.3)
    assert (warm.column_px, warm.row_px) == pytest.approx((140, 80), abs=0.3)
    assert (cold.contrast_K, warm.contrast_K) == pytest.approx((-3.0, 2.0), abs=0.2)
    assert (cold.area_px, warm.area_px) == pytest.approx((np.pi * 8**2, np.pi * 12**2), rel=0.1)


#: Four markers of 36 mm, about 28 px, within circles of 52 mm.
MARKERS = [
    Fiducial("M7", 120, 40, 52, marker=7),
    Fiducial("M11", 440, 90, 52, marker=11),
    Fiducial("M23", 280, 130, 52, marker=23),
    Fiducial("M42", 600, 135, 52, marker=42),
]
SCENE = Scene(disc_K=-4.0)


def with_markers(image, numbers, contrast_K):
    """Print markers of 36 mm with a quiet zone into a frame, through its own homography."""
    image = image.copy()
    for one, number in zip(MARKERS, numbers, strict=True):
        pattern = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(DICTIONARY), number, 288)
        pattern = np.pad(pattern, 48, constant_values=255)
        half = 36 / 2 * 384 / 288
        corners = [(one.x_mm + a * half, one.y_mm + b * half) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        to_frame = cv2.getPerspectiveTransform(
            np.array([(0, 0), (383, 0), (383, 383), (0, 383)], "f4"), SCENE.to_pixels(np.array(corners)).astype("f4")
        )
        size = image.shape[::-1]
        dark = cv2.warpPerspective((255.0 - pattern).astype("f4"), to_frame, size, flags=cv2.INTER_AREA) / 255
        image += contrast_K * dark
    return image


@pytest.mark.parametrize("contrast_K", [-4.0, 4.0])
def test_markers_are_found_dark_and_bright(contrast_K, rng):
    frame = with_markers(SCENE.render(rng), (7, 11, 23, 42), contrast_K)
    found = detect_markers(frame)
    assert set(found) == {7, 11, 23, 42}
    for one in MARKERS:
        # Good enough for a hint, which may be wrong by 20 px.
        assert np.hypot(*(found[one.marker] - SCENE.to_pixels(np.array([(one.x_mm, one.y_mm)]))[0])) < 2


@pytest.mark.parametrize("contrast_K", [-0.3, 0.3])
def test_faint_markers_are_found_beside_a_wide_range(contrast_K, rng):
    frame = with_markers(SCENE.render(rng), (7, 11, 23, 42), contrast_K)
    assert set(detect_markers(frame)) == {7, 11, 23, 42}
    assert detect_markers(SCENE.render(rng)) == {}


def test_hints_by_markers_locate_the_plan_as_the_discs_do(rng):
    frame = with_markers(SCENE.render(rng), (7, 11, 23, 42), -4.0)
    hinted = identify_plan(frame, [*DISCS, *MARKERS])
    places = SCENE.to_pixels(np.array([(disc.x_mm, disc.y_mm) for disc in DISCS]))
    assert [one.name for one in hinted] == [disc.name for disc in DISCS]
    assert max(np.hypot(*(np.array(one.hint_px) - place)) for one, place in zip(hinted, places, strict=True)) < 20
    own = replace(DISCS[0], column_px=1.0, row_px=2.0)
    assert identify_plan(frame, [own, *DISCS[1:], *MARKERS])[0].hint_px == (1.0, 2.0)
    registration = register(frame, [*DISCS, *MARKERS], grid=GRID)
    # As accurate as by discs alone: the markers take no part.
    assert SCENE.registration_rms_mm(registration) < 0.03
    assert set(registration.fiducials) <= {disc.name for disc in DISCS}
    assert {one.marker for one in registration.masked} == {None, 7, 11, 23, 42}


def test_another_table_is_refused(rng):
    frame = with_markers(SCENE.render(rng), (1, 2, 3, 4), -4.0)
    with pytest.raises(MarkerError, match=r"frames show the markers 1, 2, 3, 4, the plan lists 7, 11, 23, 42: this"):
        register(frame, [*DISCS, *MARKERS], grid=GRID)


def test_without_markers_in_view_the_discs_do_alone(rng):
    frame = SCENE.render(rng)
    assert identify_plan(frame, [*DISCS, *MARKERS]) == DISCS
    assert identify_plan(frame, DISCS) == DISCS


@pytest.mark.parametrize("noise_K", [0.01, 0.1])
def test_discs_whose_blur_reaches_the_frames_edge_are_found(noise_K):
    """Discs of 6 px, 3 px from the edge of an 80 x 60 picture: the less noise, the farther out a spot stands out of it."""
    rows, columns = np.mgrid[0:480, 0:640] / 8.0
    fine = np.full(rows.shape, 24.0)
    for x in (6.0, 74.0):
        for y in (6.0, 20.0, 34.0, 54.0):
            fine[np.hypot(columns - x, rows - y) < 3.0] = 20.0
    frame = fine.reshape(60, 8, 80, 8).mean(axis=(1, 3))
    found = detect_discs(frame + np.random.default_rng(2).normal(0.0, noise_K, frame.shape))
    assert len(found) == 8
