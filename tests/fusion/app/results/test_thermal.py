from __future__ import annotations

from pathlib import Path

import numpy as np
import panel as pn
import pytest
from bokeh.events import Tap
from bokeh.models import LinearColorMapper

from fusion.app.results.products import Products
from fusion.app.results.selection import Linker, Place, Selection
from fusion.app.results.thermal import ThermalView
from tests.fusion.app.texts import texts


@pytest.fixture
def seen(results_folder: Path) -> tuple[Products, Selection, ThermalView]:
    products = Products(results_folder)
    selection = Selection(cycle=24, target=2)
    linker = Linker(selection, products.targets, products.cycles, products.field_hours)
    return products, selection, ThermalView(products, selection, linker)


def image(view: ThermalView) -> np.ndarray:
    """What the map shows."""
    drawn = view.view.select(pn.pane.Bokeh)[0].object
    return np.asarray(drawn.select_one("cells").data_source.data["image"][0])


def test_the_map_follows_the_cycle_on_one_scale(seen: tuple[Products, Selection, ThermalView]) -> None:
    products, selection, view = seen
    np.testing.assert_array_equal(image(view), products.map_of(products.layers[0], 24))
    mapper = view.view.select(pn.pane.Bokeh)[0].object.select_one(LinearColorMapper)
    scale = (mapper.low, mapper.high)
    (player,) = view.view.select(pn.widgets.Player)
    player.value = 5
    assert selection.cycle == 5 and (mapper.low, mapper.high) == scale
    np.testing.assert_array_equal(image(view), products.map_of(products.layers[0], 5))
    assert "Cycle 5 (" in texts([view.view])


def test_another_quantity_has_its_own_scale_and_unit(seen: tuple[Products, Selection, ThermalView]) -> None:
    _, _, view = seen
    view.view.select(pn.widgets.Select)[0].value = "temperature"
    mapper = view.view.select(pn.pane.Bokeh)[0].object.select_one(LinearColorMapper)
    assert mapper.low > 10.0
    assert "°C" in texts([view.view])


def test_a_click_and_typed_numbers_add_places_and_the_list_removes_them(
    seen: tuple[Products, Selection, ThermalView],
) -> None:
    _, selection, view = seen
    drawn = view.view.select(pn.pane.Bokeh)[0].object
    drawn._trigger_event(Tap(drawn, x=100.0, y=50.0))
    drawn._trigger_event(Tap(drawn, x=-500.0, y=50.0))
    assert selection.places == [Place(100.0, 50.0, 0.0)]
    add = next(button for button in view.view.select(pn.widgets.Button) if button.label == "Add place")
    add.clicks += 1
    assert len(selection.places) == 2
    assert "x 100 mm, y 50 mm: 0 to" in texts([view.view])
    (chosen,) = view.view.select(pn.widgets.MultiChoice)
    chosen.value = chosen.value[1:]
    assert Place(100.0, 50.0, 0.0) not in selection.places and len(selection.places) == 1
