from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from fusion.app.results.changed import ChangeError, free_name, stages_again, write_changed
from fusion.campaign.config import CampaignError, load_campaign


def test_two_values_change_and_every_other_line_stays(copied: Path) -> None:
    campaign = copied / "campaign.toml"
    before = campaign.read_text(encoding="utf-8")
    changed = write_changed(campaign, emissivity=0.9, declared=["axis_expansion"])
    assert changed == copied / "campaign_2.toml"
    assert campaign.read_text(encoding="utf-8") == before
    lines = changed.read_text(encoding="utf-8").splitlines()
    others = [line for line in before.splitlines() if not line.startswith(("emissivity", "declared"))]
    assert [line for line in others if line not in lines] == []
    assert "emissivity = 0.9  # changed from 0.97" in lines
    assert load_campaign(changed).model.declared == ("axis_expansion",)


def test_an_uncertainty_a_list_over_lines_and_a_region_survive(copied: Path) -> None:
    campaign = copied / "campaign.toml"
    text = campaign.read_text(encoding="utf-8")
    text = text.replace("emissivity = 0.97", 'emissivity = "0.97 +- 0.02"  # paint')
    text = text.replace(
        'declared = ["axis_expansion", "table_offset"]', 'declared = [\n  "axis_expansion",\n  "table_offset",\n]'
    )
    region = "name = 'rail'\nemissivity = 0.3\npolygon = [['0 mm', '0 mm'], ['90 mm', '0 mm'], ['90 mm', '90 mm']]\n\n"
    text = text.replace("[plan]\n", f"[[thermography.region]]\n{region}[plan]\n", 1)
    campaign.write_text(text, encoding="utf-8")
    before = tomllib.loads(text)
    told = tomllib.loads(write_changed(campaign, emissivity=0.9, declared=["table_offset"]).read_text(encoding="utf-8"))
    assert told["thermography"]["emissivity"] == "0.9 +- 0.02"
    assert told["thermography"]["region"] == before["thermography"]["region"]
    assert told["model"]["declared"] == ["table_offset"]


def test_a_table_that_is_missing_is_added(copied: Path) -> None:
    campaign = copied / "campaign.toml"
    text = campaign.read_text(encoding="utf-8")
    campaign.write_text(text[: text.index("[model]")], encoding="utf-8")
    assert load_campaign(write_changed(campaign, declared=["table_offset"])).model.declared == ("table_offset",)


def test_impossible_values_and_other_ways_of_writing_leave_no_file(copied: Path) -> None:
    campaign = copied / "campaign.toml"
    with pytest.raises(CampaignError, match="declared"):
        write_changed(campaign, declared=["gremlins"])
    text = campaign.read_text(encoding="utf-8")
    campaign.write_text(text.replace("[model]\ndeclared", "[model]\n'declared'"), encoding="utf-8")
    with pytest.raises(ChangeError, match=r"campaign\.toml: the change could not be entered; write it into a copy"):
        write_changed(campaign, declared=["table_offset"])
    assert not (copied / "campaign_2.toml").exists()


def test_names_count_on(tmp_path: Path) -> None:
    assert free_name(tmp_path / "results").name == "results_2"
    (tmp_path / "results_2").mkdir()
    assert free_name(tmp_path / "results_2").name == "results_3"


def test_it_says_what_is_computed_again() -> None:
    assert "the deviations are kept" in stages_again(emissivity=True, declared=True)
    assert "thermal fields, deviations and correlation are kept" in stages_again(emissivity=False, declared=True)
    assert stages_again(emissivity=False, declared=False) == "nothing was changed"
