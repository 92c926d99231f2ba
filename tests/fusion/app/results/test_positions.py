from __future__ import annotations

from pathlib import Path

import numpy as np
import panel as pn
import pytest

from fusion.app.results.positions import anomaly_cards
from fusion.app.results.products import Products
from fusion.app.results.selection import Selection
from fusion.products.results import AnomalyPart
from tests.fusion.app.texts import texts
from tests.fusion.results_sample import PARTS


@pytest.fixture
def products(results_folder: Path) -> Products:
    """The results with one position that stands out, whose texts hold markup."""
    loaded = Products(results_folder)
    one = {**PARTS["anomalies"][0], "position_mm": 100.0}
    one["evidence"] = {**one["evidence"], "for": ["<b>bold</b>"]}
    loaded.results = loaded.results.model_copy(update={"anomalies": (AnomalyPart.model_validate(one),)})
    return loaded


def test_a_card_says_why_shows_the_field_and_chooses_the_position(products: Products) -> None:
    selection = Selection(cycle=2, target=1)
    (card,) = anomaly_cards(products, selection)
    told = texts([card])
    assert "Position 3, both approaches: scatter of the structure" in told
    assert "What to inspect: c" in told and "in cycle 2:" in told
    assert not any("<b>bold" in str(pane.object) for pane in card.select(pn.pane.HTML))
    (field,) = card.select(pn.pane.Bokeh)
    before = field.object.renderers[0].data_source.data["image"][0]
    selection.cycle = 20
    assert "in cycle 20:" in texts([card])
    assert np.nanmean(field.object.renderers[0].data_source.data["image"][0]) != pytest.approx(np.nanmean(before))
    (button,) = card.select(pn.widgets.Button)
    button.clicks += 1
    assert selection.target == 3


def test_none_and_not_examined_are_told_apart(products: Products) -> None:
    products.results = products.results.model_copy(update={"anomalies": ()})
    assert "No position stands out" in texts(anomaly_cards(products, Selection()))
    products.results = products.results.model_copy(update={"anomalies": None})
    assert "was not examined" in texts(anomaly_cards(products, Selection()))


def test_without_a_camera_the_card_says_so(products: Products, tmp_path: Path) -> None:
    products.fields = None
    assert "The camera did not see this position." in texts(anomaly_cards(products, Selection()))
