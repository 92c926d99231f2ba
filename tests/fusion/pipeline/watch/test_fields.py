"""The field of a cycle while the test runs: registered as soon as the plan is seen, one mean per cycle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import load_campaign
from fusion.pipeline.watch.fields import FieldsOfCycles
from thermography.io.frame_readers import index_recordings
from thermography.registration.evidence import RegistrationError


def test_the_mean_of_a_cycle_is_the_mean_of_its_frames(campaign_folder: Path) -> None:
    campaign = load_campaign(campaign_folder / "campaign.toml")
    frames, _ = index_recordings(campaign.frame_paths())
    fields = FieldsOfCycles(campaign)
    fields.reduce(frames[:5])
    together, warnings = fields.reduce(frames[5:8])
    singly = [fields.reduce([frame])[0] for frame in frames[5:8]]
    assert together is not None and warnings == ()
    np.testing.assert_allclose(together.values, np.mean(singly, axis=0), atol=2e-3)
    assert together.dims == ("y", "x") and together.attrs["units"] == "degC"


def test_a_plan_that_is_not_seen_is_looked_for_again_ever_less_often(
    campaign_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fusion.pipeline.watch.fields as module

    calls = []

    def refuse(*arguments: object, **options: object) -> None:
        calls.append(1)
        raise RegistrationError("too few discs")

    campaign = load_campaign(campaign_folder / "campaign.toml")
    frames, _ = index_recordings(campaign.frame_paths())
    monkeypatch.setattr(module, "register", refuse)
    fields = FieldsOfCycles(campaign)
    told = [fields.reduce(frames[:1]) for _ in range(20)]
    assert len(calls) == 5 and told[0] == (None, ("too few discs",)) and told[2] == (None, ())
    monkeypatch.undo()
    assert [fields.reduce(frames[:1])[0] is not None for _ in range(20)][-1]


def test_no_frame_is_said(campaign_folder: Path) -> None:
    fields = FieldsOfCycles(load_campaign(campaign_folder / "campaign.toml"))
    assert fields.reduce([]) == (None, ("no frame in this cycle",))


def test_a_frame_that_cannot_be_read_costs_its_cycle_only(copied: Path) -> None:
    campaign = load_campaign(copied / "campaign.toml")
    frames, _ = index_recordings(campaign.frame_paths())
    fields = FieldsOfCycles(campaign)
    assert fields.reduce(frames[:2])[0] is not None
    frames[2].path.unlink()
    field, warnings = fields.reduce(frames[2:3])
    assert field is None and frames[2].path.name in warnings[0]
    assert fields.reduce(frames[3:4])[0] is not None
