"""A region is added with a name, an emissivity and two corners, or not at all."""

from __future__ import annotations

from fusion.app.setup.regions_view import RegionsView


def test_a_drawn_region_is_added_once_and_removed() -> None:
    changes: list[None] = []
    view = RegionsView(lambda: changes.append(None))
    view.show([])
    view._add(None)
    assert not view.regions and "needs a name of its own" in view._told.object
    for expected in (1, 1):
        view.take_corners((1.0, 2.0), (30.0, 40.0))
        view._name.value, view._emissivity.value = "way", "0.35 +- 0.05"
        view._add(None)
        assert len(view.regions) == expected, "a second region of that name is refused"
    assert view.regions[0]["rectangle"] == [["1 mm", "2 mm"], ["30 mm", "40 mm"]] and len(changes) == 1
    view._remove(None)
    assert view.regions == [] and len(changes) == 2
