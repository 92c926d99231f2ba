"""Parts of the screen *Results*: laser, closed loop, positions, and the thermal map."""

import numpy as np
import panel as pn
import pytest
import xarray as xr
from bokeh.events import Tap
from bokeh.models import LinearColorMapper, Text

from fusion.app.results.charts import (
    ThermalView,
    anomaly_cards,
    effects_left,
    laser_charts,
    loop_steps,
    reading_hours,
    record_charts,
    table_of,
)
from fusion.app.results.data import Linker, Place, Products, Selection
from fusion.report.wording import caption, table
from fusion.results.axis import SourcePart
from fusion.results.parts import AreaPart
from fusion.results.results import AnomalyPart, AxisLoop, CorrelationPart
from fusion.results.store import DamagedProductError
from tests.fusion.app.texts import texts
from tests.fusion.report.test_record import record
from tests.fusion.results_sample import PARTS


def linker_of(products, selection):
    return Linker(selection, products.targets, products.cycles, reading_hours(products))


def test_profile_drift_and_standard_are_there(products):
    selection = Selection(cycle=3, target=2)
    told = texts(laser_charts(products, selection, linker_of(products, selection)))
    for words in (*map(caption, ("profile", "drift", "history", "windows")), "ISO 230-2", "A = "):
        assert words.rstrip(".") in told


def test_the_chosen_position_is_drawn_over_the_others(products):
    selection = Selection(cycle=3, target=2)
    parts = laser_charts(products, selection, linker_of(products, selection))
    course = parts[2].select(pn.pane.Bokeh)[0].object
    chosen = course.renderers[-1].data_source
    before = np.array(chosen.data["y"])
    selection.target = 5
    np.testing.assert_allclose(chosen.data["y"], products.drift["drift"].mean("direction").sel(target=5).values)
    assert not np.allclose(before, chosen.data["y"])


def test_the_readings_follow_the_choice(products):
    selection = Selection(cycle=3, target=2)
    parts = laser_charts(products, selection, linker_of(products, selection))
    assert "Readings at 50 mm" in texts(parts)
    selection.target = 4
    assert "Readings at 150 mm" in texts(parts) and "Readings at 50 mm" not in texts(parts)


def parts_of(products):
    selection = Selection(cycle=1, target=1)
    return texts(loop_steps(products, Linker(selection, products.targets, products.cycles, None)))


def test_every_round_has_residual_scores_and_effect(products):
    told, loop = parts_of(products), products.results.loop
    assert isinstance(loop, AxisLoop) and loop.steps
    for turn in range(1, len(loop.steps) + 1):
        assert f"Round {turn}" in told
    of_round = ("Residual before this round", "Best candidate of every effect in round 1", "Entered")
    for words in (*of_round, "What the final model leaves", "What to do next"):
        assert words in told


def test_before_a_step_its_effect_is_put_back():
    dims = ("cycle", "direction", "target")
    stored = xr.Dataset(
        {
            "residual_final": (dims, np.full((2, 2, 3), 0.5)),
            "contribution": (("effect", *dims), np.arange(3.0)[:, None, None, None] * np.ones((3, 2, 2, 3))),
        }
    )
    loop = AxisLoop.model_construct(declared=("axis_expansion",), steps=(object(), object()))
    assert float(effects_left(stored, loop, 0)[0, 0, 0]) == 0.5 + 1.0 + 2.0
    assert float(effects_left(stored, loop, 1)[0, 0, 0]) == 0.5 + 2.0
    assert float(effects_left(stored, loop, 2)[0, 0, 0]) == 0.5


def test_steps_of_another_run_are_refused(products):
    loop = products.results.loop
    assert isinstance(loop, AxisLoop) and loop.steps
    other = Products(products.folder)
    for steps in (loop.steps * 20, (loop.steps[0].model_copy(update={"effect": "dead_path"}),)):
        other.results = products.results.model_copy(update={"loop": loop.model_copy(update={"steps": steps})})
        with pytest.raises(DamagedProductError, match=r"fusion\.nc: its effects are not the steps of results\.json"):
            parts_of(other)


def test_text_of_a_table_is_never_markup():
    shown = table_of(table(["a", "b"], [["<b>x</b>", "1"]]), "<i>caption</i>")
    assert "<b>x" not in shown.object and "&lt;b&gt;x" in shown.object and "<i>" not in shown.object


def test_the_charts_of_one_displacement_of_a_record_are_chosen_in_a_menu():
    measured = record(channels=3).assign(driver_units=("driver_name", ["1/min"]), driver_size=("driver_name", [1.0]))
    measured["displacement"].loc[{"channel": "c1"}] = [0.0, 1.0, 2.0, 3.0]
    shown = pn.Column(*record_charts(measured))
    (menu,) = shown.select(pn.widgets.Select)
    assert menu.options == ["X", "c1", "c2"] and menu.value == "c1", "the one that moves most stands first"
    assert len(shown.select(pn.pane.Bokeh)) == 4, "two of the displacement, temperatures, drivers"
    assert "c1 measured from 0" in texts([shown]) and "X measured" not in texts([shown])
    menu.value = "X"
    assert "X measured from" in texts([shown])


@pytest.fixture
def marked(results_folder):
    """The results with one position that stands out, whose texts hold markup."""
    loaded = Products(results_folder)
    one = {**PARTS["anomalies"][0], "position_mm": 100.0}
    one["evidence"] = {**one["evidence"], "for": ["<b>bold</b>"]}
    loaded.results = loaded.results.model_copy(update={"anomalies": (AnomalyPart.model_validate(one),)})
    return loaded


def test_a_card_says_why_below_the_scatter_of_every_position_and_chooses_the_position(marked):
    selection = Selection(cycle=2, target=1)
    scatter, card = anomaly_cards(marked, selection)
    assert "marked as standing out: 100 mm" in texts([scatter])
    told = texts([card])
    assert "Position 3, both approaches: mechanical scatter" in told
    assert "What to inspect: c" in told
    assert not any("<b>bold" in str(pane.object) for pane in card.select(pn.pane.HTML))
    (button,) = card.select(pn.widgets.Button)
    button.clicks += 1
    assert selection.target == 3


def test_that_no_position_stands_out_is_told(marked):
    marked.results = marked.results.model_copy(update={"anomalies": ()})
    assert "No position stands out" in texts(anomaly_cards(marked, Selection()))


@pytest.fixture
def seen(results_folder):
    products = Products(results_folder)
    selection = Selection(cycle=24, target=2)
    linker = Linker(selection, products.targets, products.cycles, products.field_hours)
    return products, selection, ThermalView(products, selection, linker)


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
        selection = Selection(cycle=24, target=2)
        view = ThermalView(products, selection, Linker(selection, products.targets, products.cycles, None))
        drawn = view.view.select(pn.pane.Bokeh)[0].object
        texts = [one for one in drawn.renderers if isinstance(one.glyph, Text)]
        return {word for one in texts for word in np.ravel(one.data_source.data.get(one.glyph.text, one.glyph.text))}

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
