"""Markers name the plan and hint its discs; where the plan lies is the discs' business, to the same digit."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, GRID, Scene
from thermography.registration.markers import DICTIONARY, MarkerError, detect_markers, identify_plan
from thermography.registration.plan import Fiducial
from thermography.registration.register import register

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
    with pytest.raises(
        MarkerError,
        match=r"frames show the markers 1, 2, 3, 4, the plan lists 7, 11, 23, 42: this is another table; name",
    ):
        register(frame, [*DISCS, *MARKERS], grid=GRID)


def test_without_markers_in_view_the_discs_do_alone(rng):
    frame = SCENE.render(rng)
    assert identify_plan(frame, [*DISCS, *MARKERS]) == DISCS
    assert identify_plan(frame, DISCS) == DISCS
