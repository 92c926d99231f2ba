"""Axis and regions on the plan."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from fusion.app.setup.fiducials import Placed, place
from fusion.app.setup.plan_view import Plan, PlanView, corners_of, on_plan, region_table
from thermography.registration.plan import Fiducial

PLAN = Plan(200.0, 100.0, (150.0, 50.0), (-1.0, 0.0), (0.0, 50.0, 100.0))


def test_targets_lie_along_the_direction() -> None:
    np.testing.assert_allclose(PLAN.targets_mm(), [(150, 50), (100, 50), (50, 50)])
    assert len(Plan(200.0, 100.0, (0.0, 0.0)).targets_mm()) == 0


def test_the_thermogram_lies_on_the_plan_where_it_belongs() -> None:
    corners = [(10, 10), (190, 12), (188, 90), (12, 88), (100, 50)]
    fiducials = [Fiducial(f"F{i}", x, y, 0.0, 2.0 * x, 2.0 * y) for i, (x, y) in enumerate(corners)]
    frame = np.tile(np.arange(300.0), (200, 1))
    registration = place(fiducials, frame.shape).registration
    assert registration is not None
    seen = on_plan(frame, registration, PLAN)
    assert seen.shape[1] / seen.shape[0] == pytest.approx(2.0, abs=0.02)
    middle = seen[seen.shape[0] // 2]
    x_mm = (np.arange(middle.size) + 0.5) * 200.0 / middle.size
    np.testing.assert_allclose(middle[x_mm < 149], 2 * x_mm[x_mm < 149], atol=0.6)
    assert np.isnan(middle[x_mm > 151]).all(), "the frame ends at 150 mm"


def test_clicks_draw_origin_then_direction_and_a_drag_a_region() -> None:
    drawn: list[tuple[object, ...]] = []
    view = PlanView(
        lambda x, y: drawn.append(("origin", x, y)),
        lambda dx, dy: drawn.append(("direction", dx, dy)),
        lambda one, other: drawn.append(("region", one, other)),
    )
    view.show(PLAN, Placed(), None)
    view._on_tap(SimpleNamespace(x=150.0, y=50.0))
    view._on_tap(SimpleNamespace(x=100.0, y=51.0))
    view._on_drag(SimpleNamespace(x=1.0, y=2.0))
    view._on_drop(SimpleNamespace(x=3.0, y=4.0))
    view._mode.value = "Emissivity region"
    view._on_tap(SimpleNamespace(x=0.0, y=0.0))
    view._on_drag(SimpleNamespace(x=1.0, y=2.0))
    view._on_drop(SimpleNamespace(x=3.0, y=4.0))
    assert drawn == [("origin", 150.0, 50.0), ("direction", -50.0, 1.0), ("region", (1.0, 2.0), (3.0, 4.0))]


def test_regions_are_read_as_the_campaign_file_writes_them() -> None:
    table = region_table("way", "0.3 +- 0.1", [(1.04, 2.0), (3.0, 4.0)])
    assert table == {"name": "way", "rectangle": [["1 mm", "2 mm"], ["3 mm", "4 mm"]], "emissivity": "0.3 +- 0.1"}

    def millimetres(text: str) -> float:
        return float(text.removesuffix(" mm"))

    corners = corners_of(table, millimetres)
    assert corners is not None and corners.tolist() == [[1, 2], [3, 2], [3, 4], [1, 4]]
    polygon = corners_of({"polygon": [["0 mm", "0 mm"], ["9 mm", "0 mm"], ["0 mm", "9 mm"]]}, millimetres)
    assert polygon is not None and polygon.shape == (3, 2)
    assert corners_of({}, millimetres) is None and corners_of({"rectangle": [["x", "y"]]}, millimetres) is None
