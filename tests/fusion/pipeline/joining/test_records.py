"""Two records in one command: told together, and refused beside a campaign with both instruments before any is run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import CampaignError
from fusion.pipeline.joining import records
from fusion.pipeline.run import run_campaign
from tests.fusion.campaign_parts import without

CAMPAIGN = """\
[campaign]
title = "{title}"

[record]
file = "{title}.csv"
time = "time [s]"
temperatures = ["t*"]
displacements = ["ch*"]
"""


def write_record(folder: Path, title: str) -> Path:
    """A channel that follows one sensor, an hour long."""
    rng = np.random.default_rng(5)
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.1, 60))
    noise = rng.normal(0.0, 0.05, 60)
    rows = [f"{60 * k},{t:.3f},{2.0 * t + noise[k]:.3f}" for k, t in enumerate(temperature)]
    (folder / f"{title}.csv").write_text("time [s],t1 [degC],ch1 [um]\n" + "\n".join(rows) + "\n", encoding="utf-8")
    path = folder / f"{title}.toml"
    path.write_text(CAMPAIGN.format(title=title), encoding="utf-8")
    return path


def test_two_records_are_told_together(tmp_path: Path) -> None:
    paths = [write_record(tmp_path, title) for title in ("Monday", "Tuesday")]
    assert records.of_one_kind(paths)
    folders = [tmp_path / "results" / path.stem for path in paths]
    for path, folder in zip(paths, folders, strict=True):
        run_campaign(path, folder)
    rows = records.join_records(folders, tmp_path)
    document = json.loads((tmp_path / "joint.json").read_text())
    assert document["campaigns"] == [name for name, _ in rows[:2]] == ["Monday", "Tuesday"]
    assert document["records"][0]["rmse_final_um"] == document["records"][1]["rmse_final_um"]
    assert all(one["agrees"] for one in document["agreement"])
    assert "held-out error" in rows[0][1]


def test_a_record_beside_both_instruments_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Loaded:
        def __init__(self, path: Path) -> None:
            self.record = path.stem if path.stem == "record" else None

    monkeypatch.setattr(records, "load_campaign", Loaded)
    with pytest.raises(CampaignError, match=r"record\.toml holds a \[record\], axis\.toml instruments"):
        records.of_one_kind([Path("axis.toml"), Path("record.toml")])


def test_two_campaigns_without_both_instruments_are_refused_before_any_is_run(copied: Path) -> None:
    whole = copied / "campaign.toml"
    laser = without(whole, "thermography", "plan", "model", name="laser.toml")
    camera = without(whole, "interferometry", "model", name="camera.toml")
    assert records.of_one_kind([whole, whole]) is False
    with pytest.raises(
        CampaignError, match=r"laser\.toml has no \[thermography\]; two campaigns are compared by the part"
    ):
        records.of_one_kind([whole, laser])
    with pytest.raises(CampaignError, match=r"camera\.toml has no \[interferometry\]"):
        records.of_one_kind([camera, whole])
