"""Parts of the screen *Results*: the charts of the laser and the thermal map."""

import numpy as np
import panel as pn
import pytest
from bokeh.events import Tap
from bokeh.models import LinearColorMapper, Text

from fusion.app.parts import table
from fusion.app.results import Place, Products, Selection, ThermalView, position_readings
from fusion.results.axis import CorrelationPart, SourcePart
from fusion.results.parts import AreaPart
from tests.fusion.app.texts import texts


def test_the_readings_follow_the_position_that_is_chosen(products):
    parts = position_readings(products.deviations, products.drift, 2)
    assert "Readings at 50 mm" in texts(parts)
    parts[0].value = 4
    assert "Readings at 150 mm" in texts(parts) and "Readings at 50 mm" not in texts(parts)


def test_text_of_a_table_is_never_markup():
    shown = table(["a", "b"], [["<b>x</b>", "1"]], caption="<i>caption</i>")
    assert "<b>x" not in shown.object and "&lt;b&gt;x" in shown.object and "<i>" not in shown.object


@pytest.fixture
def seen(results_folder):
    products = Products(results_folder)
    selection = Selection(cycle=24)
    return products, selection, ThermalView(products, selection)


def image(view):
    """What the map shows."""
    drawn = view.view.select(pn.pane.Bokeh)[0].object
    return np.asarray(drawn.select_one("cells").data_source.data["image"][0])


def test_the_map_follows_the_cycle_on_one_scale(seen):
    products, selection, view = seen
    np.testing.assert_array_equal(image(view), products.map_of(products.layers[0], 24))
    mapper = view.view.select(pn.pane.Bokeh)[0].object.select_one(LinearColorMapper)
    scale = (mapper.low, mapper.high)
    (player,) = view.view.select(pn.widgets.Player)
    player.value = 5
    assert selection.cycle == 5 and (mapper.low, mapper.high) == scale
    np.testing.assert_array_equal(image(view), products.map_of(products.layers[0], 5))
    assert "Cycle 5 (" in texts([view.view])


def test_the_area_that_the_drift_follows_is_drawn_on_the_map(results_folder):
    area = AreaPart(x_low_mm=280.0, x_high_mm=420.0, y_low_mm=40.0, y_high_mm=150.0)

    def written(verdict):
        products = Products(results_folder)
        source = SourcePart.model_construct(area=area)
        correlation = CorrelationPart.model_construct(verdict=verdict, source=source)
        products.results = products.results.model_copy(update={"correlation": correlation})
        selection = Selection(cycle=24)
        view = ThermalView(products, selection)
        drawn = view.view.select(pn.pane.Bokeh)[0].object
        texts = [one for one in drawn.renderers if isinstance(one.glyph, Text)]
        return {word for one in texts for word in np.ravel(one.data_source.data["text"])}

    assert "the drift follows this" in written("attributable")
    assert "the drift follows this" not in written("not attributable")


def test_another_quantity_has_its_own_scale_and_unit(seen):
    _, _, view = seen
    view.view.select(pn.widgets.Select)[0].value = "temperature"
    mapper = view.view.select(pn.pane.Bokeh)[0].object.select_one(LinearColorMapper)
    assert mapper.low > 10.0
    assert "°C" in texts([view.view])


def test_a_click_and_typed_numbers_add_places_and_the_list_removes_them(seen):
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
