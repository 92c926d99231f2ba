from __future__ import annotations

import numpy as np
import pytest
from bokeh.events import Tap
from bokeh.models import Span
from bokeh.plotting import figure

from fusion.app.results.selection import CYCLE, HOURS, POSITION, Linker, Place, Selection

TARGETS = [(1, 0.0), (3, 50.0), (2, 100.0)]


@pytest.fixture
def linked() -> tuple[Selection, figure, figure]:
    selection = Selection(cycle=4, target=1)
    linker = Linker(selection, TARGETS, np.array([1, 2, 4]), np.array([0.1, 0.2, 0.5]))
    field, course = figure(), figure()
    linker.link(field, x=CYCLE, y=POSITION)
    linker.link(course, x=HOURS)
    return selection, field, course


def tap(drawn: figure, x: float, y: float) -> None:
    drawn._trigger_event(Tap(drawn, x=x, y=y))


def places(drawn: figure) -> list[float | None]:
    return [span.location for span in drawn.center if isinstance(span, Span)]


def test_a_click_chooses_the_nearest_and_every_chart_follows(linked: tuple[Selection, figure, figure]) -> None:
    selection, field, course = linked
    assert places(field) == [4.0, 0.0] and places(course) == [0.5]
    tap(field, 2.4, 61.0)
    assert (selection.cycle, selection.target) == (2, 3)
    assert places(field) == [2.0, 50.0] and places(course) == [0.2]
    tap(course, 0.0, 99.0)
    assert (selection.cycle, selection.target) == (1, 3)


def test_a_chart_that_is_drawn_anew_no_longer_follows() -> None:
    selection, drawn = Selection(cycle=1), figure()
    unlink = Linker(selection, [], np.array([1, 2]), None).link(drawn, x=CYCLE, y=POSITION)
    unlink()
    selection.cycle = 2
    assert places(drawn) == [1.0, None]


def test_without_times_or_targets_a_click_chooses_nothing() -> None:
    selection, drawn = Selection(cycle=1), figure()
    Linker(selection, [], np.array([1, 2]), None).link(drawn, x=HOURS, y=POSITION)
    tap(drawn, 3.0, 3.0)
    assert (selection.cycle, selection.target) == (1, None)


def test_a_place_is_added_once_and_named() -> None:
    selection = Selection()
    for _ in range(2):
        selection.add(Place(10.0, 20.0, 0.0))
    selection.add(Place(10.0, 20.0, 30.0))
    assert [place.words for place in selection.places] == ["x 10 mm, y 20 mm", "x 10 mm, y 20 mm, 30 mm square"]
