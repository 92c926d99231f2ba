from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import panel as pn
import pytest

from fusion.app.results.charts import PositionHistory, laser_charts, reading_hours, shown
from fusion.app.results.products import Products
from fusion.app.results.selection import Linker, Selection
from fusion.report.charts.style import Chart, new_figure
from tests.fusion.app.texts import texts


def linker_of(products: Products, selection: Selection) -> Linker:
    return Linker(selection, products.targets, products.cycles, reading_hours(products))


@pytest.fixture(scope="module")
def products(results_folder: Path) -> Products:
    return Products(results_folder)


def test_profile_drift_and_standard_are_there(products: Products) -> None:
    selection = Selection(cycle=3, target=2)
    told = texts(laser_charts(products, selection, linker_of(products, selection)))
    for words in ("Deviation along the axis", "Drift of every position", "Readings at", "ISO 230-2", "A = "):
        assert words in told


def test_the_chosen_position_is_drawn_over_the_others(products: Products) -> None:
    selection = Selection(cycle=3, target=2)
    parts = laser_charts(products, selection, linker_of(products, selection))
    course = parts[2].select(pn.pane.Bokeh)[0].object
    chosen = course.renderers[-1].data_source
    assert products.drift is not None
    before = np.array(chosen.data["y"])
    selection.target = 5
    np.testing.assert_allclose(chosen.data["y"], products.drift["drift"].mean("direction").sel(target=5).values)
    assert not np.allclose(before, chosen.data["y"])


def test_the_readings_follow_the_choice(products: Products) -> None:
    selection = Selection(cycle=3, target=2)
    history = PositionHistory(products, selection, linker_of(products, selection))
    assert "Readings at 50 mm" in texts([history.view])
    selection.target = 4
    assert "Readings at 150 mm" in texts([history.view])


def test_without_a_laser_it_says_so(results_folder: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(results_folder, tmp_path / "camera")
    (folder / "deviations.nc").unlink()
    camera, selection = Products(folder), Selection(cycle=1)
    assert reading_hours(camera) is None
    assert "no readings of a laser" in texts(
        laser_charts(camera, selection, Linker(selection, [], camera.cycles, None))
    )


def test_a_chart_has_its_caption_and_says_what_is_seen() -> None:
    told = texts([shown(Chart(new_figure(x="x", y="y"), "Seen <so>.", {}), "Caption <b>")])
    assert "Caption <b>" in told and "Seen <so>." in told
