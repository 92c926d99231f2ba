"""Fiducials are found as by a run, and placed by hand with the residual of each."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.app.setup.fiducials import (
    PICKED,
    FiducialsError,
    Placed,
    added,
    changed,
    find,
    first_thermogram,
    nearest,
    place,
    removed,
    snapped,
    write_picked,
)
from thermography.registration.plan import Fiducial, PlanGrid, read_fiducials

GRID = PlanGrid(700, 180, 20)


@pytest.fixture(scope="module")
def frame(campaign_folder: Path) -> NDArray[np.float64]:
    return first_thermogram(sorted((campaign_folder / "thermal").glob("*.jpg")))


@pytest.fixture(scope="module")
def found(campaign_folder: Path, frame: NDArray[np.float64]) -> Placed:
    return find(frame, read_fiducials(campaign_folder / "fiducials.csv"), GRID)


def test_the_discs_of_the_first_frame_are_found_without_hints(found: Placed, frame: NDArray[np.float64]) -> None:
    bare = [replace(one, column_px=None, row_px=None) for one in found.fiducials]
    again = find(frame, bare, GRID)
    assert again.message.startswith("12 fiducials agree: residual 0.0")
    for one, other in zip(found.fiducials, again.fiducials, strict=True):
        assert one.hint_px == pytest.approx(other.hint_px, abs=0.01)


def test_a_moved_place_has_its_residual_in_millimetres(found: Placed, frame: NDArray[np.float64]) -> None:
    first = found.fiducials[0]
    assert first.column_px is not None and found.registration is not None
    moved = changed(found, first.name, frame.shape, column_px=first.column_px + 12.0)
    there = found.registration.to_plan(np.array([first.column_px + 12.0, first.row_px]))
    expected = math.hypot(there[0] - first.x_mm, there[1] - first.y_mm)
    assert moved.residual_mm[first.name] == pytest.approx(expected, abs=0.3), "twelve pixels, seen from the others"
    far = changed(found, first.name, frame.shape, column_px=first.column_px + 60.0)
    assert far.residual_mm[first.name] > 4 * expected, "also where it contradicts the others"
    assert f"{first.name} lies {moved.residual_mm[first.name]:.2f} mm from where the others expect it" in moved.message


def test_a_clicked_disc_gets_its_centre_and_its_position_from_the_others(
    found: Placed, frame: NDArray[np.float64]
) -> None:
    target = found.fiducials[-1]
    assert target.column_px is not None and target.row_px is not None
    fewer = removed(found, target.name, frame.shape)
    assert len(fewer.fiducials) == 11
    place_px = snapped(frame, target.column_px + 4, target.row_px - 3)
    assert place_px == pytest.approx((target.column_px, target.row_px), abs=0.5)
    again, name = added(fewer, *place_px, frame.shape)
    assert name not in {one.name for one in fewer.fiducials} and again.fiducials[-1].diameter_mm == target.diameter_mm
    assert (again.named(name).x_mm, again.named(name).y_mm) == pytest.approx((target.x_mm, target.y_mm), abs=1.0)
    assert snapped(frame, 5.0, 5.0) == (5.0, 5.0), "where no disc is, the click counts"


def test_without_others_the_position_is_left_open_and_must_be_typed(tmp_path: Path, frame: NDArray[np.float64]) -> None:
    placed, name = added(Placed(), 100.0, 50.0, frame.shape)
    assert math.isnan(placed.named(name).x_mm) and placed.registration is None
    assert "0 of at least 4 fiducials" in placed.message
    with pytest.raises(
        FiducialsError, match=r"F1: the position on the plan is missing; type x and y in mm, or remove it"
    ):
        write_picked(tmp_path, placed)


def test_nearest_is_within_reach_or_none(found: Placed) -> None:
    one = found.fiducials[2]
    assert one.column_px is not None and one.row_px is not None
    assert nearest(found, one.column_px + 3, one.row_px, reach_px=10) == one.name
    assert nearest(found, one.column_px + 30, one.row_px + 30, reach_px=10) is None
    assert nearest(Placed(), 0, 0, reach_px=10) is None


def test_a_written_list_is_read_back(tmp_path: Path, found: Placed) -> None:
    strange = replace(found.fiducials[0], name='F,1 "a"')
    path = write_picked(tmp_path, replace(found, fiducials=(strange, *found.fiducials[1:])))
    assert path.name == PICKED
    back = read_fiducials(path)
    assert back[0].name == strange.name and len(back) == 12
    assert back[3].hint_px == pytest.approx(found.fiducials[3].hint_px, abs=0.006), "two digits are written"


def test_what_contradicts_or_cannot_be_found_is_told(frame: NDArray[np.float64]) -> None:
    corners = [
        Fiducial(f"P{i}", x, y, 16.0, 10.0 * i, 20.0 * (i % 2))
        for i, (x, y) in enumerate([(0, 0), (700, 0), (0, 180), (700, 180)])
    ]
    assert "Not found automatically:" in find(np.full_like(frame, 20.0), corners, GRID).message
    in_line = [replace(one, row_px=0.0) for one in corners]
    assert "contradict one another" in place(in_line, frame.shape).message


def test_a_frame_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff nothing")
    with pytest.raises(FiducialsError, match=r"no frame can be shown: .*; copy the file again"):
        first_thermogram([tmp_path / "a.jpg"])
