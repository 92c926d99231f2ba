from __future__ import annotations

import shutil
from pathlib import Path

import panel as pn
import pytest

from fusion.app.results.again import RunAgain
from fusion.app.results.products import Products
from fusion.app.state import State
from tests.fusion.app.texts import texts


@pytest.fixture
def form(copied: Path, results_folder: Path) -> tuple[State, RunAgain]:
    results = shutil.copytree(results_folder, copied / "results")
    state = State(root=copied, campaign=copied / "campaign.toml", results=results)
    return state, RunAgain(state, Products(results))


def button(again: RunAgain) -> pn.widgets.Button:
    return next(iter(again.view.select(pn.widgets.Button)))


def test_it_starts_only_after_a_change_and_says_what_is_kept(form: tuple[State, RunAgain]) -> None:
    _, again = form
    assert button(again).disabled
    (emissivity,) = again.view.select(pn.widgets.FloatInput)
    assert emissivity.value == 0.97
    emissivity.value = 0.9
    assert not button(again).disabled and "the deviations are kept" in texts([again.view])
    emissivity.value = 0.97
    (declared,) = again.view.select(pn.widgets.CheckBoxGroup)
    declared.value = ["axis_expansion"]
    assert "thermal fields, deviations and correlation are kept" in texts([again.view])


def test_a_file_outside_the_folder_is_not_changed(form: tuple[State, RunAgain], tmp_path: Path) -> None:
    state, _ = form
    products = Products(state.results)
    products.provenance = {"campaign_file": "../../elsewhere/campaign.toml", "parameters": {}}
    elsewhere = State(root=state.root, results=state.results)
    assert "is not in the folder of the application" in texts([RunAgain(elsewhere, products).view])


@pytest.mark.parametrize(
    "parameters",
    [
        [],
        None,
        {"thermography": [], "model": 5},
        {"thermography": {"emissivity": "0.9"}, "model": {"declared": 5}},
        {"thermography": {"emissivity": -5}, "model": {"declared": [1, [2], "<img src=x>"]}},
        {"thermography": {"emissivity": 1e400}, "model": {"declared": {"a": 1}}},
    ],
)
def test_parameters_that_no_run_wrote_are_left_empty(form: tuple[State, RunAgain], parameters: object) -> None:
    state, _ = form
    products = Products(state.results)
    products.provenance = {"campaign_file": "x" * 5000, "parameters": parameters}
    view = RunAgain(state, products).view
    assert [one.value for one in view.select(pn.widgets.FloatInput)] == [None]
    assert [one.value for one in view.select(pn.widgets.CheckBoxGroup)] == [[]]
