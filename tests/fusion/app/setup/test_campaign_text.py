"""A campaign file keeps its comments while its values change, and is never lost."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from fusion.app.setup.campaign_text import CampaignTextError, open_campaign
from fusion.starting.draft import DraftError


def test_a_folder_without_a_campaign_file_gets_the_draft_of_init(copied: Path) -> None:
    (copied / "campaign.toml").unlink()
    campaign = open_campaign(copied)
    assert campaign.saved is None and campaign.text.startswith("# Written by thermofuse init.")
    assert (
        campaign.value("plan", "axis", "origin") == [None, None] and campaign.value("plan", "axis", "direction") is None
    )
    changed = campaign.with_values(
        {
            ("plan", "axis", "origin"): ["500 mm", "90 mm"],
            ("plan", "axis", "direction"): [-1, 0],
            ("thermography", "emissivity"): "0.97",
            ("thermography", "region"): [
                {"name": "way", "rectangle": [["0 mm", "0 mm"], ["10 mm", "20 mm"]], "emissivity": "0.3"}
            ],
            ("report", "machine"): 'a "machine"',
        }
    )
    lines = changed.text.splitlines()
    assert 'origin = ["500 mm", "90 mm"]   # plan point under the spindle at axis position 0' in lines
    assert any(line.startswith('emissivity = "0.97"') for line in lines) and not any(
        line.startswith("# emissivity") for line in lines
    )
    saved = changed.save()
    assert saved.save() is saved, "nothing is written twice"
    assert tomllib.loads((copied / "campaign.toml").read_text())["report"]["machine"] == 'a "machine"'
    again = open_campaign(copied)
    assert again.value("thermography", "region")[0]["name"] == "way"
    without = again.with_values(
        {("thermography", "region"): None, ("report", "machine"): None, ("absent", "key"): None}
    )
    assert without.value("thermography", "region") is None and without.value("report", "machine") is None


def test_the_version_before_stays_and_a_change_by_another_is_not_lost(copied: Path) -> None:
    before = (copied / "campaign.toml").read_text()
    one, other = open_campaign(copied), open_campaign(copied)
    one.with_values({("campaign", "title"): "one"}).save()
    assert (copied / "campaign.toml.before").read_text() == before
    with pytest.raises(CampaignTextError, match="was changed by another page or program since it was opened here"):
        other.with_values({("campaign", "title"): "other"}).save()
    assert tomllib.loads((copied / "campaign.toml").read_text())["campaign"]["title"] == "one"


def test_what_is_no_toml_and_an_empty_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DraftError, match="neither thermal frames nor deviations"):
        open_campaign(tmp_path)
    (tmp_path / "campaign.toml").write_text("[campaign\n")
    with pytest.raises(CampaignTextError, match=r"this is not TOML .* correct it in an editor"):
        open_campaign(tmp_path)


def test_nothing_that_somebody_wrote_is_lost(tmp_path: Path) -> None:
    written = (
        '# mine\r\n[thermography]\r\n# emissivity = measured in March\r\n# clock_offset = "2 s" by the old clock\r\n'
        'operator = "unknown key"\r\n[plan.axis]\r\norigin = [ "1 mm", # from the drawing\r\n "2 mm" ] # y\r\n'
    )
    (tmp_path / "campaign.toml").write_bytes(written.encode())
    changed = open_campaign(tmp_path).with_values(
        {
            ("thermography", "emissivity"): "0.9",
            ("thermography", "clock_offset"): "3 s",
            ("plan", "axis", "origin"): ["3 mm", "2 mm"],
        }
    )
    changed.save()
    assert (tmp_path / "campaign.toml.before").read_bytes() == written.encode()
    saved = (tmp_path / "campaign.toml").read_bytes().decode()
    assert saved.count("\n") == saved.count("\r\n"), "line endings stay"
    for line in written.replace('"1 mm"', '"3 mm"').splitlines():
        assert line in saved
    assert tomllib.loads(saved)["thermography"] == {
        "operator": "unknown key",
        "emissivity": "0.9",
        "clock_offset": "3 s",
    }


def test_a_remark_in_a_draft_that_is_no_value_stays(tmp_path: Path) -> None:
    draft = "# Written by thermofuse init. Every\n[thermography]\n# emissivity = measured in March\n"
    (tmp_path / "campaign.toml").write_text(draft)
    changed = open_campaign(tmp_path).with_values({("thermography", "emissivity"): "0.9"})
    assert changed.text == draft + 'emissivity = "0.9"\n'


def test_a_value_under_the_name_of_a_table_is_refused(tmp_path: Path) -> None:
    (tmp_path / "campaign.toml").write_text("campaign = 5\n")
    with pytest.raises(CampaignTextError, match=r"campaign is no table; write \[campaign\]"):
        open_campaign(tmp_path).with_values({("campaign", "title"): "x"})
