"""Provenance: versions, hashes and parameters of a run, without names of machine or user."""

from __future__ import annotations

import hashlib
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest

from fusion.campaign.config import load_campaign
from fusion.pipeline.provenance import describe_run, hash_inputs, versions


def test_inputs_are_hashed_by_name(tmp_path: Path) -> None:
    (tmp_path / "laser.csv").write_bytes(b"readings")
    told: list[tuple[str, int, int]] = []
    hashed = hash_inputs({"laser.csv": tmp_path / "laser.csv"}, report=lambda *step: told.append(step))
    assert hashed == {"laser.csv": {"bytes": 8, "sha256": hashlib.sha256(b"readings").hexdigest()}}
    assert told == [("input files", 0, 1), ("input files", 1, 1)]


def test_a_run_is_described_without_a_folder(campaign_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = load_campaign(campaign_folder / "campaign.toml")
    monkeypatch.setattr(sys, "argv", ["/opt/bin/thermofuse", "run", str(campaign.path), "--resume"])
    run = describe_run(campaign, {}, started=datetime(2026, 3, 9, 6, 30, tzinfo=UTC), seconds={"fields": 1.234})
    assert run["command"] == ["thermofuse", "run", "campaign.toml", "--resume"]
    assert run["started"] == "2026-03-09T06:30:00+00:00" and run["stage_seconds"] == {"fields": 1.23}
    assert run["parameters"]["plan"]["cell_size_mm"] == 20.0 and "path" not in run["parameters"]


def test_every_version_is_known() -> None:
    known = versions()
    assert known["python"].startswith("3.") and "not installed" not in {known["numpy"], known["xarray"]}
