"""The form shows what the campaign file says, and tells what was typed."""

from __future__ import annotations

from pathlib import Path

from fusion.app.setup.campaign_text import open_campaign
from fusion.app.setup.fields import read_fields
from fusion.app.setup.form import Form


def test_the_form_reads_back_what_it_shows(campaign_folder: Path) -> None:
    changes: list[str] = []
    form = Form(changes.append)
    campaign = open_campaign(campaign_folder)
    form.show(campaign)
    assert form.texts == read_fields(campaign) and not changes
    form.write({"width": "710 mm", "no such field": "x"})
    assert form.texts["width"] == "710 mm" and changes == ["width"]
