"""Fields are read from a campaign file and written back, each with its unit."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion.app.setup.campaign_text import open_campaign
from fusion.app.setup.fields import FieldError, direction_text, missing, read_direction, read_fields, write_fields
from fusion.campaign.config import load_campaign


def test_fields_are_read_back(copied: Path) -> None:
    texts = read_fields(open_campaign(copied))
    assert (texts["title"], texts["width"], texts["direction"], texts["table"]) == (
        "Small campaign",
        "700 mm",
        "left",
        "still",
    )
    assert texts["machine"] == "", "a table that can be added is shown"


def test_changed_fields_are_written_and_all_others_stay(copied: Path) -> None:
    campaign = open_campaign(copied)
    assert write_fields(campaign, read_fields(campaign)).text == campaign.text
    texts = {
        "width": "720 mm",
        "emissivity": "0.9 +- 0.02",
        "direction": "0.8, 0.6",
        "machine": "Mill 3",
        "reflected": "",
    }
    write_fields(campaign, texts).save()
    loaded = load_campaign(copied / "campaign.toml")
    assert loaded.plan is not None and loaded.thermography is not None and loaded.plan.axis is not None
    assert loaded.plan.size_mm == (720.0, 180.0)
    assert loaded.thermography.emissivity_u == 0.02 and loaded.thermography.reflected_temperature_degC is None
    assert loaded.plan.axis.direction == (0.8, 0.6)


def test_a_needed_field_may_be_left_for_later(copied: Path) -> None:
    campaign = write_fields(open_campaign(copied), {"origin_x": ""})
    assert campaign.value("plan", "axis", "origin")[0] is None and campaign.value("plan", "axis", "origin")[1]
    assert missing(campaign) == ["Spindle at axis position 0, x"] and missing(open_campaign(copied)) == []
    (copied / "campaign.toml").unlink()
    (copied / "fiducials.csv").unlink()
    assert missing(open_campaign(copied))[-1] == 'fiducials = "FILL IN"'


def test_every_fault_is_named_with_its_field(copied: Path) -> None:
    with pytest.raises(
        FieldError, match=r"(?s)Width of the plan \(x\): .*unit.*It moves, as the position grows: .* no direction"
    ):
        write_fields(open_campaign(copied), {"width": "700", "direction": "0, 0"})


@pytest.mark.parametrize(
    ("drawn", "text"), [((9, 0.1), "right"), ((-5, 0), "left"), ((0.0, 3), "down"), ((3, -4), "0.6000, -0.8000")]
)
def test_a_drawn_direction_is_a_word_where_it_follows_a_side(drawn: tuple[float, float], text: str) -> None:
    assert direction_text(*drawn) == text
    x, y = read_direction(text)
    assert x * drawn[0] + y * drawn[1] > 0


@pytest.mark.parametrize("text", ["", "sideways", "1", "1, 2, 3", "nan, 1", "0, 0"])
def test_what_is_no_direction_is_refused(text: str) -> None:
    with pytest.raises(FieldError, match="write right, left, down, up"):
        read_direction(text)
