from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.app.results.closed_loop import effects_left, loop_steps, table_of
from fusion.app.results.products import Products
from fusion.app.results.selection import Linker, Selection
from fusion.products.results import AxisLoop
from fusion.products.store import DamagedProductError
from fusion.report.tables import table
from tests.fusion.app.texts import texts


@pytest.fixture(scope="module")
def products(results_folder: Path) -> Products:
    return Products(results_folder)


def parts_of(products: Products) -> str:
    selection = Selection(cycle=1, target=1)
    return texts(loop_steps(products, Linker(selection, products.targets, products.cycles, None)))


def test_every_round_has_residual_scores_and_effect(products: Products) -> None:
    told, loop = parts_of(products), products.results.loop
    assert isinstance(loop, AxisLoop) and loop.steps
    for turn in range(1, len(loop.steps) + 1):
        assert f"Round {turn}" in told
    named = (
        "Residual before this round",
        "Best candidate of every effect in round 1",
        "Entered",
        "What the final model leaves",
    )
    for words in (*named, "What to do next"):
        assert words in told


def test_before_a_step_its_effect_is_put_back() -> None:
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


def test_without_a_model_it_says_so(products: Products) -> None:
    bare = Products(products.folder)
    bare.results = products.results.model_copy(update={"loop": None})
    assert "There is no model of the drift in this run." in parts_of(bare)


def test_text_of_a_table_is_never_markup() -> None:
    shown = table_of(table(["a", "b"], [["<b>x</b>", "1"]]), "<i>caption</i>")
    assert "<b>x" not in shown.object and "&lt;b&gt;x" in shown.object and "<i>" not in shown.object


def test_steps_of_another_run_are_refused(products: Products) -> None:
    loop = products.results.loop
    assert isinstance(loop, AxisLoop) and loop.steps
    other = Products(products.folder)
    for steps in (loop.steps * 20, (loop.steps[0].model_copy(update={"effect": "dead_path"}),)):
        other.results = products.results.model_copy(update={"loop": loop.model_copy(update={"steps": steps})})
        with pytest.raises(DamagedProductError, match=r"fusion\.nc: its effects are not the steps of results\.json"):
            parts_of(other)
