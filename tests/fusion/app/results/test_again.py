"""A run again with two values changed: every other line of the campaign file stays."""

import shutil
import tomllib

import panel as pn
import pytest

from fusion.app.parts import State
from fusion.app.results.again import RunAgain, write_changed
from fusion.app.results.data import Products
from fusion.campaign.config import CampaignError, load_campaign
from tests.fusion.app.texts import texts


@pytest.fixture
def form(copied, results_folder):
    results = shutil.copytree(results_folder, copied / "results")
    state = State(root=copied, campaign=copied / "campaign.toml", results=results)
    return state, RunAgain(state, Products(results))


def button(again):
    return next(iter(again.view.select(pn.widgets.Button)))


def test_it_starts_only_after_a_change_and_says_what_is_kept(form):
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


def test_the_file_of_another_campaign_is_not_changed(form):
    state, _ = form
    other = state.root / "other.toml"
    other.write_text('[campaign]\ntitle = "another"\n')
    again = RunAgain(State(root=state.root, campaign=other, results=state.results), Products(state.results))
    assert again._campaign() == state.root / "campaign.toml"
    (state.root / "campaign.toml").rename(state.root / "elsewhere.toml")
    assert again._campaign() is None


def test_a_file_outside_the_folder_is_not_changed(form, tmp_path):
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
def test_parameters_that_no_run_wrote_are_left_empty(form, parameters):
    state, _ = form
    products = Products(state.results)
    products.provenance |= {"campaign_file": "x" * 5000, "parameters": parameters}
    view = RunAgain(state, products).view
    assert [one.value for one in view.select(pn.widgets.FloatInput)] == [None]
    assert [one.value for one in view.select(pn.widgets.CheckBoxGroup)] == [[]]


def test_two_values_change_and_every_other_line_stays(copied):
    campaign = copied / "campaign.toml"
    before = campaign.read_text(encoding="utf-8")
    changed = write_changed(campaign, emissivity=0.9, declared=["axis_expansion"])
    assert changed == copied / "campaign_2.toml"
    assert campaign.read_text(encoding="utf-8") == before
    lines = changed.read_text(encoding="utf-8").splitlines()
    others = [line for line in before.splitlines() if not line.startswith(("emissivity", "declared"))]
    assert [line for line in others if line not in lines] == []
    assert any(line.startswith("emissivity = 0.9") and "# changed from 0.97" in line for line in lines)
    assert load_campaign(changed).model.declared == ("axis_expansion",)


def test_an_uncertainty_a_list_over_lines_and_a_region_survive(copied):
    campaign = copied / "campaign.toml"
    text = campaign.read_text(encoding="utf-8")
    text = text.replace("emissivity = 0.97", 'emissivity = "0.97 +- 0.02"  # paint')
    text = text.replace('declared = ["axis_expansion", ', 'declared = [\n  "axis_expansion",\n  ')
    region = "name = 'rail'\nemissivity = 0.3\npolygon = [['0 mm', '0 mm'], ['90 mm', '0 mm'], ['90 mm', '90 mm']]\n\n"
    text = text.replace("[plan]\n", f"[[thermography.region]]\n{region}[plan]\n", 1)
    campaign.write_text(text, encoding="utf-8")
    before = tomllib.loads(text)
    written = write_changed(campaign, emissivity=0.9, declared=["table_offset"]).read_text(encoding="utf-8")
    told = tomllib.loads(written)
    assert told["thermography"]["emissivity"] == "0.9 +- 0.02" and "# paint" in written
    assert told["thermography"]["region"] == before["thermography"]["region"]
    assert told["model"]["declared"] == ["table_offset"]


def test_a_table_that_is_missing_is_added(copied):
    campaign = copied / "campaign.toml"
    text = campaign.read_text(encoding="utf-8")
    campaign.write_text(text[: text.index("[model]")], encoding="utf-8")
    assert load_campaign(write_changed(campaign, declared=["table_offset"])).model.declared == ("table_offset",)


def test_impossible_values_leave_no_file_and_other_ways_of_writing_are_read(copied):
    campaign = copied / "campaign.toml"
    with pytest.raises(CampaignError, match="declared"):
        write_changed(campaign, declared=["gremlins"])
    assert not (copied / "campaign_2.toml").exists()
    text = campaign.read_text(encoding="utf-8")
    campaign.write_text(text.replace("[model]\ndeclared", "[model]\n'declared'"), encoding="utf-8")
    assert load_campaign(write_changed(campaign, declared=["table_offset"])).model.declared == ("table_offset",)
