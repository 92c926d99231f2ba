"""Fiducials follow the pointer and the typed numbers."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from fusion.app.setup.fiducials import place
from fusion.app.setup.frame_view import FrameView
from thermography.registration.plan import Fiducial

#: Seven points of a plan of 200 mm x 100 mm, at 2 px/mm.
POINTS = [(20, 20), (100, 15), (180, 25), (25, 80), (110, 85), (180, 78), (60, 50)]


@pytest.fixture
def view() -> FrameView:
    shown = FrameView(lambda: None)
    fiducials = [Fiducial(f"F{i}", x, y, 12.0, 2.0 * x, 2.0 * y) for i, (x, y) in enumerate(POINTS)]
    shown.show(np.full((200, 400), 22.0), place(fiducials, (200, 400)), None)
    return shown


def test_a_dragged_fiducial_tells_its_residual_on_the_way(view: FrameView) -> None:
    assert max(view.placed.residual_mm.values()) < 1e-6
    view._on_start(SimpleNamespace(x=41.0, y=40.0))
    view._on_drag(SimpleNamespace(x=60.0, y=40.0))
    assert view.placed.residual_mm["F0"] == pytest.approx(10.0, abs=0.5), "20 px at 2 px/mm"
    assert (
        "F0 10.00 mm" in view._points.data["label"] and "F0 lies 10.00 mm from where the others" in view._message.object
    )
    view._on_end(SimpleNamespace(x=40.0, y=40.0))
    assert view.placed.residual_mm["F0"] < 1e-6 and view._chosen.value == "F0"


def test_a_drag_beside_all_fiducials_moves_none(view: FrameView) -> None:
    before = view.placed
    view._on_start(SimpleNamespace(x=300.0, y=100.0))
    view._on_drag(SimpleNamespace(x=310.0, y=100.0))
    view._on_end(SimpleNamespace(x=310.0, y=100.0))
    assert view.placed is before


def test_a_click_adds_only_where_it_is_asked_to(view: FrameView) -> None:
    view._on_tap(SimpleNamespace(x=300.0, y=100.0))
    assert len(view.placed.fiducials) == 7
    view._adds.value = True
    view._on_tap(SimpleNamespace(x=300.0, y=100.0))
    assert len(view.placed.fiducials) == 8 and view.placed.fiducials[-1].x_mm == 150.0
    view._remove(None)
    assert [one.name for one in view.placed.fiducials] == [f"F{i}" for i in range(7)]


def test_typed_numbers_move_a_fiducial(view: FrameView) -> None:
    view._chosen.value = "F3"
    assert view._numbers["x_mm"].value == 25.0
    view._numbers["x_mm"].value = 27.0
    assert view.placed.named("F3").x_mm == 27.0 and view.placed.residual_mm["F3"] > 0.3
