"""Fiducials are found as by a run, and placed by hand with the residual of each."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import panel as pn
import pytest
from bokeh.models import Scatter, Text

from fusion.app.setup import plan as module
from fusion.app.setup.plan import (
    FiducialsError,
    FrameView,
    Placed,
    Plan,
    PlanView,
    RegionsView,
    changed,
    corners_of,
    find,
    on_plan,
    place,
    region_table,
)
from interferometry.plots import INK
from thermography.registration.plan import Fiducial, PlanGrid, read_fiducials

pytestmark = pytest.mark.long

GRID = PlanGrid(700, 180, 20)


@pytest.fixture(scope="module")
def frame(campaign_folder):
    return module.first_thermogram(sorted((campaign_folder / "thermal").glob("*.jpg")))


@pytest.fixture(scope="module")
def found(campaign_folder, frame):
    return find(frame, read_fiducials(campaign_folder / "fiducials.csv"), GRID)


def test_the_discs_of_the_first_frame_are_found_without_hints(found, frame):
    bare = [replace(one, column_px=None, row_px=None) for one in found.fiducials]
    again = find(frame, bare, GRID)
    assert again.message.startswith("12 fiducials agree: residual 0.0")
    for one, other in zip(found.fiducials, again.fiducials, strict=True):
        assert one.hint_px == pytest.approx(other.hint_px, abs=0.01)


def test_a_moved_place_has_its_residual_in_millimetres(found, frame):
    first = found.fiducials[0]
    assert first.column_px is not None
    moved = changed(found, first.name, frame.shape, column_px=first.column_px + 12.0)
    there = found.registration.to_plan(np.array([first.column_px + 12.0, first.row_px]))
    expected = math.hypot(there[0] - first.x_mm, there[1] - first.y_mm)
    assert moved.residual_mm[first.name] == pytest.approx(expected, abs=0.3), "twelve pixels, seen from the others"
    far = changed(found, first.name, frame.shape, column_px=first.column_px + 60.0)
    assert far.residual_mm[first.name] > 4 * expected, "also where it contradicts the others"
    assert f"{first.name} lies {moved.residual_mm[first.name]:.2f} mm from where the others expect it" in moved.message


def test_a_clicked_disc_gets_its_centre_and_its_position_from_the_others(found, frame):
    target = found.fiducials[-1]
    assert target.column_px is not None and target.row_px is not None
    fewer = module.removed(found, target.name, frame.shape)
    assert len(fewer.fiducials) == 11
    place_px = module.snapped(frame, target.column_px + 4, target.row_px - 3)
    assert place_px == pytest.approx((target.column_px, target.row_px), abs=0.5)
    again, name = module.added(fewer, *place_px, frame.shape)
    assert name not in {one.name for one in fewer.fiducials} and again.fiducials[-1].diameter_mm == target.diameter_mm
    assert (again.named(name).x_mm, again.named(name).y_mm) == pytest.approx((target.x_mm, target.y_mm), abs=1.0)
    assert module.snapped(frame, 5.0, 5.0) == (5.0, 5.0), "where no disc is, the click counts"


def test_without_others_the_position_is_left_open_and_must_be_typed(tmp_path, frame):
    placed, name = module.added(Placed(), 100.0, 50.0, frame.shape)
    assert math.isnan(placed.named(name).x_mm) and placed.registration is None
    assert "0 of at least 4 fiducials" in placed.message
    with pytest.raises(FiducialsError, match=r"F1: the position on the plan is missing; type x and y in mm, or remove"):
        module.write_picked(tmp_path, placed)


def test_a_written_list_is_read_back(tmp_path, found):
    strange = replace(found.fiducials[0], name='F,1 "a"')
    path = module.write_picked(tmp_path, replace(found, fiducials=(strange, *found.fiducials[1:])))
    assert path.name == module.PICKED
    back = read_fiducials(path)
    assert back[0].name == strange.name and len(back) == 12
    assert back[3].hint_px == pytest.approx(found.fiducials[3].hint_px, abs=0.006), "two digits are written"


def test_what_contradicts_or_cannot_be_found_is_told(frame):
    corners = [
        Fiducial(f"P{i}", x, y, 16.0, 10.0 * i, 20.0 * (i % 2))
        for i, (x, y) in enumerate([(0, 0), (700, 0), (0, 180), (700, 180)])
    ]
    assert "Not found automatically:" in find(np.full_like(frame, 20.0), corners, GRID).message
    in_line = [replace(one, row_px=0.0) for one in corners]
    assert "contradict one another" in place(in_line, frame.shape).message


def test_a_frame_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff nothing")
    with pytest.raises(FiducialsError, match=r"no frame can be shown: .*; copy the file again"):
        module.first_thermogram([tmp_path / "a.jpg"])


#: Seven points of a plan of 200 mm x 100 mm, at 2 px/mm.
POINTS = [(20, 20), (100, 15), (180, 25), (25, 80), (110, 85), (180, 78), (60, 50)]


@pytest.fixture
def view():
    shown = FrameView(lambda: None)
    fiducials = [Fiducial(f"F{i}", x, y, 12.0, 2.0 * x, 2.0 * y) for i, (x, y) in enumerate(POINTS)]
    shown.show(np.full((200, 400), 22.0), place(fiducials, (200, 400)), None)
    return shown


def test_a_dragged_fiducial_tells_its_residual_on_the_way(view):
    assert max(view.placed.residual_mm.values()) < 1e-6
    view._on_start(SimpleNamespace(x=41.0, y=40.0))
    view._on_drag(SimpleNamespace(x=60.0, y=40.0))
    assert view.placed.residual_mm["F0"] == pytest.approx(10.0, abs=0.5), "20 px at 2 px/mm"
    assert "F0 10.00 mm" in view._points.data["label"]
    assert "F0 lies 10.00 mm from where the others" in view._message.object
    view._on_end(SimpleNamespace(x=40.0, y=40.0))
    assert view.placed.residual_mm["F0"] < 1e-6 and view._chosen.value == "F0"


def test_a_click_adds_only_where_it_is_asked_to(view):
    view._on_tap(SimpleNamespace(x=300.0, y=100.0))
    assert len(view.placed.fiducials) == 7
    view._adds.value = True
    view._on_tap(SimpleNamespace(x=300.0, y=100.0))
    assert len(view.placed.fiducials) == 8 and view.placed.fiducials[-1].x_mm == 150.0
    view._remove(None)
    assert [one.name for one in view.placed.fiducials] == [f"F{i}" for i in range(7)]


PLAN = Plan(200.0, 100.0, (150.0, 50.0), (-1.0, 0.0), (0.0, 50.0, 100.0))


def test_the_thermogram_lies_on_the_plan_where_it_belongs():
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


def test_clicks_draw_origin_then_direction_and_a_drag_a_region():
    drawn = []
    view = PlanView(
        lambda x, y: drawn.append(("origin", x, y)),
        lambda dx, dy: drawn.append(("direction", dx, dy)),
        lambda point: drawn.append(("point", point)),
        lambda one, other: drawn.append(("region", one, other)),
    )
    view.show(PLAN, Placed(), None)
    view._on_tap(SimpleNamespace(x=150.0, y=50.0))
    view._on_tap(SimpleNamespace(x=100.0, y=51.0))
    view._on_drag(SimpleNamespace(x=1.0, y=2.0))
    view._on_drop(SimpleNamespace(x=3.0, y=4.0))
    view._mode.value = "Region"
    view._on_tap(SimpleNamespace(x=0.0, y=0.0))
    view._on_drag(SimpleNamespace(x=1.0, y=2.0))
    view._on_drop(SimpleNamespace(x=3.0, y=4.0))
    assert drawn == [
        ("origin", 150.0, 50.0),
        ("direction", -50.0, 1.0),
        ("point", (0.0, 0.0)),
        ("region", (1.0, 2.0), (3.0, 4.0)),
    ]


def test_the_plan_marks_its_origin_and_names_its_fiducials_as_the_camera_sees_them():
    view = PlanView(*[lambda *drawn: None] * 4)
    view.show(PLAN, Placed((Fiducial("F1", 10.0, 15.0, 0.0),)), None)
    (pane,) = view.view.select(pn.pane.Bokeh)
    names = {}
    for one in pane.object.renderers:
        if isinstance(one.glyph, Text):
            data = one.data_source.data
            names |= dict(zip(data["text"], zip(data["x"], data["y"], strict=True), strict=True))
    assert names == {"F1": (10.0, 15.0), "origin": (0, 0)}
    assert pane.object.y_range.start > pane.object.y_range.end, "y points downwards: F1 is at the top left"
    glyphs = [one.glyph for one in pane.object.renderers]
    crosses = [one.line_color for one in glyphs if isinstance(one, Scatter) and one.marker == "cross"]
    assert crosses == ["#ffffff", INK] * 2, "dark on light is seen on any page"


def test_regions_are_read_as_the_campaign_file_writes_them():
    table = region_table("way", "0.3 +- 0.1", "rectangle", [(1.04, 2.0), (3.0, 4.0)])
    assert table == {"name": "way", "rectangle": [["1 mm", "2 mm"], ["3 mm", "4 mm"]], "emissivity": "0.3 +- 0.1"}
    corners = corners_of(table)
    assert corners.tolist() == [[1, 2], [3, 2], [3, 4], [1, 4]]
    polygon = corners_of({"polygon": [["0 mm", "0 mm"], ["9 mm", "0 mm"], ["0 mm", "9 mm"]]})
    assert polygon.shape == (3, 2)
    assert corners_of({"spot": ["3 px", "4 px"]}).tolist() == [[3, 4]]
    assert corners_of({"ellipse": [["0 mm", "0 mm"], ["4 mm", "2 mm"]]}).max(axis=0).tolist() == pytest.approx(
        [4, 2], abs=0.01
    )
    assert corners_of({}) is None and corners_of({"rectangle": [["x", "y"]]}) is None


def test_a_drawn_region_is_added_once_and_removed():
    changes = []
    view = RegionsView(lambda: changes.append(None))
    view.show([])
    view._add(None)
    assert not view.regions and "needs a name of its own" in view._told.object
    for expected in (1, 1):
        view.take_corners((1.0, 2.0), (30.0, 40.0))
        view._name.value, view._emissivity.value = "way", "0.35 +- 0.05"
        view._add(None)
        assert len(view.regions) == expected, "a second region of that name is refused"
    assert view.regions[0]["rectangle"] == [["1 mm", "2 mm"], ["30 mm", "40 mm"]] and changes
    view._remove(None)
    assert view.regions == []
    view.show([], "px")
    view.take_corners((1.0, 2.0), (30.0, 40.0))
    view._name.value, view._emissivity.value = "way", ""
    view._add(None)
    assert view.regions == [{"name": "way", "rectangle": [["1 px", "2 px"], ["30 px", "40 px"]]}]
    assert corners_of(view.regions[0]).tolist()[2] == [30.0, 40.0]


@pytest.mark.parametrize(
    ("shape", "clicked", "written"),
    [
        ("spot", [(9, 9), (1, 2)], ["1 mm", "2 mm"]),
        ("line", [(9, 9), (8, 8), (1, 2), (3, 4)], [["1 mm", "2 mm"], ["3 mm", "4 mm"]]),
        ("polygon", [(0, 0), (9, 0), (0, 9)], [["0 mm", "0 mm"], ["9 mm", "0 mm"], ["0 mm", "9 mm"]]),
    ],
)
def test_a_shape_is_clicked_point_by_point_and_seen_while_it_is_drawn(shape, clicked, written):
    view = RegionsView(lambda: None)
    view._shape.value = shape
    for point in clicked:
        view.take_point(point)
    view._name.value = "zone"
    assert [name for name, _ in view.outlines] == ["zone"]
    view._add(None)
    assert view.regions == [{"name": "zone", shape: written}] and len(view.outlines) == 1
    view._points.value = "1, 2; three"
    view._name.value = "other"
    view._add(None)
    assert "needs a name of its own and" in view._told.object and len(view.regions) == 1
