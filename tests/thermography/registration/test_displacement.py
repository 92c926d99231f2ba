"""Shifts of known size, measured on the fiducials and on the image of the table alone."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, GRID, SC660, START, Scene, cell_truth, record, registered
from thermography.fields.resampling import plan_window
from thermography.fields.still import reduce_frames
from thermography.radiometry.planck import counts_from_temperature
from thermography.registration.displacement import (
    SUSPECT_PX,
    fiducial_displacement,
    image_displacement,
    monitor_fiducials,
    register_after_knock,
    search_displacement,
    shift_registration,
    zoom_and_turn,
)
from thermography.registration.register import RegistrationError

pytestmark = pytest.mark.long

BARE = Scene(discs=())


@pytest.fixture(scope="module")
def registration():
    return registered()


def monitored(frames, registration):
    """What the monitor shows of frames, (n, row, column) degC."""
    rows, columns = plan_window(registration, GRID)
    counts = np.round(counts_from_temperature(frames, SC660)).astype(np.uint16)[:, rows, columns]
    # Counts of 6 mK: 50 mK of noise are 8 counts.
    return monitor_fiducials(registration, GRID, (rows, columns)).displacements(counts, 8.0)


@pytest.mark.parametrize("shift", [(3.0, -2.0), (0.4, 0.3), (0.0, 0.0), (-6.0, 5.0)])
def test_shift_of_a_table_without_contrast_of_its_discs(rng, registration, shift):
    reference, frame = BARE.render(rng), replace(BARE, shift_px=shift).render(rng)
    # It has warmed by 1 K since, at one end by 3 K.
    frame = frame + 1.0 + 2.0 * np.linspace(0, 1, 640)
    assert image_displacement(reference, frame, registration, GRID) == pytest.approx([*shift, 0.0, 0.0], abs=0.1)


def test_pictures_that_do_not_agree_give_no_shift(rng, registration):
    other = rng.normal(22, 1.0, (480, 640))
    assert np.isnan(image_displacement(BARE.render(rng), other, registration, GRID)).all()


def test_shifted_registration_puts_the_plan_where_the_picture_went(registration):
    moved = replace(Scene(disc_K=-4.0), shift_px=(3.0, -2.0))
    assert moved.registration_rms_mm(shift_registration(registration, np.array([3.0, -2.0]))) < 0.03


def test_knock_while_the_discs_have_no_contrast_is_found_and_mended(rng, registration, tmp_path):
    moved = replace(BARE, shift_px=(3.0, -2.0))
    images = [(BARE if i < 2 else moved).render(rng) for i in range(4)]
    frames = record(tmp_path / "a.seq", images)
    fields = reduce_frames(frames, registration, GRID, START + np.array([0, 2, 4]) * np.timedelta64(1, "s"))
    (knock,) = json.loads(fields.attrs["knocks"])
    assert knock["index"] == 2
    assert knock["shift_px"] == pytest.approx([3.0, -2.0], abs=0.1)
    error = fields["temperature"].values[1] - cell_truth()
    assert np.sqrt(np.nanmean(error**2)) < 0.01


def test_monitor_and_located_fiducials_show_the_shift_of_each_frame(rng, registration):
    shifts = [(0.0, 0.0), (0.2, -0.1), (-0.7, 0.2)]
    frames = np.stack([replace(Scene(disc_K=-4.0), shift_px=shift).render(rng) for shift in shifts])
    shown = monitored(frames, registration)[:, :2]
    # The monitor is linear for shifts well below the width of an edge; what may be a knock shows beyond the limit for a closer look.
    np.testing.assert_allclose(shown[:2], shifts[:2], atol=0.02)
    assert np.linalg.norm(shown[2]) > SUSPECT_PX
    for frame, shift in zip(frames, shifts, strict=True):
        np.testing.assert_allclose(fiducial_displacement(frame, registration, GRID), [*shift, 0.0, 0.0], atol=0.02)


def test_discs_without_contrast_show_no_shift(rng, registration):
    frame = BARE.render(rng)
    assert np.isnan(monitored(frame[None], registration)).all()
    assert np.isnan(fiducial_displacement(frame, registration, GRID)).all()


def test_registration_after_a_knock_is_that_of_the_moved_table_or_names_the_frame(rng, registration):
    moved = replace(Scene(disc_K=-4.0), shift_px=(3.0, -2.0))
    shift = np.array([3.0, -2.0, 0.0, 0.0])
    again = register_after_knock(moved.render(rng), registration, shift, GRID, frame_name="a.seq#7")
    assert moved.registration_rms_mm(again) < 0.05
    with pytest.raises(RegistrationError, match=r"a\.seq#7: the fiducials moved by \(3\.0, -2\.0\) px and the plan"):
        register_after_knock(BARE.render(rng), registration, shift, GRID, frame_name="a.seq#7")


@pytest.mark.parametrize(("zoom", "turn_deg", "shift"), [(1.0, 1.0, (2.0, -1.0)), (0.99, -0.5, (0.0, 3.0))])
def test_zoom_and_turn_are_measured_with_the_shift(rng, registration, zoom, turn_deg, shift):
    places = np.array([(d.column_px, d.row_px) for d in registration.located.values()])
    middle = places.mean(axis=0)
    warp = cv2.getRotationMatrix2D(middle, -turn_deg, zoom)
    warp[:, 2] += shift
    frame = cv2.warpAffine(
        Scene(disc_K=-4.0).render(rng), warp, (640, 480), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    measured = fiducial_displacement(frame, registration, GRID)
    np.testing.assert_allclose(measured[:2], shift, atol=0.03)
    # 0.04 px at 220 px from the middle.
    assert zoom_and_turn(measured, registration) == pytest.approx((zoom, turn_deg), abs=0.01, rel=1e-4)
    searched = search_displacement(Scene(disc_K=-4.0).render(rng), frame, registration, GRID)
    np.testing.assert_allclose(searched, measured, atol=0.05)


def test_a_table_that_is_not_in_the_frame_has_no_displacement(rng, registration):
    empty = rng.normal(22.0, 0.05, (480, 640))
    assert np.isnan(search_displacement(Scene(disc_K=-4.0).render(rng), empty, registration, GRID)).all()
    assert np.isnan(fiducial_displacement(empty, registration, GRID)).all()


def test_discs_that_are_covered_or_imitated_have_no_influence(rng, registration):
    covered = Scene(disc_K=-4.0, discs=tuple(DISCS[:8])).render(rng)
    np.testing.assert_allclose(fiducial_displacement(covered, registration, GRID), 0.0, atol=0.03)
    moved = tuple(replace(d, x_mm=d.x_mm + 6.0) if i < 4 else d for i, d in enumerate(DISCS))
    imitated = Scene(disc_K=-4.0, discs=moved).render(rng)
    np.testing.assert_allclose(fiducial_displacement(imitated, registration, GRID), 0.0, atol=0.05)


def test_a_shifted_registration_is_less_certain(registration):
    shifted = shift_registration(registration, np.array([3.0, -2.0]))
    place = np.array([350.0, 90.0])
    per_px = 1 / np.sqrt(abs(np.linalg.det(registration.projection.jacobian(place))))
    added = np.sqrt(shifted.position_u(place - 3.0) ** 2 - registration.position_u(place) ** 2)
    # 0.1 px in either coordinate.
    assert added == pytest.approx(0.1 * np.sqrt(2.0) * per_px, rel=0.1)
