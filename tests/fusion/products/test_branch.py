from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from fusion.pipeline.run import run_campaign
from fusion.products.branch import branch_results
from fusion.products.store import OutputError, file_sha256, finished_stages


def sums(folder: Path) -> dict[str, str]:
    """SHA-256 of every product of a results folder."""
    return {path.name: file_sha256(path) for path in folder.iterdir() if path.is_file()}


def test_a_run_in_the_branch_computes_only_what_changed_and_leaves_the_first_run_alone(
    campaign_folder: Path, results_folder: Path, tmp_path: Path
) -> None:
    """Without the expansion the model is another one; fields, deviations and correlation do not depend on what is declared."""
    campaign = shutil.copytree(campaign_folder, tmp_path / "campaign") / "campaign.toml"
    text = campaign.read_text(encoding="utf-8")
    changed = campaign.with_name("changed.toml")
    changed.write_text(text.replace('["axis_expansion", "table_offset"]', '["axis_expansion"]'), encoding="utf-8")
    assert changed.read_text(encoding="utf-8") != text
    before = sums(results_folder)
    branch = tmp_path / "branch"
    assert branch_results(results_folder, branch) == finished_stages(results_folder)
    told: list[str] = []
    results = run_campaign(changed, branch, resume=True, report=lambda label, done, total: told.append(label))
    assert {label for label in told if "(kept)" in label} == {
        "thermal fields (kept)",
        "deviations (kept)",
        "correlation (kept)",
    }
    assert results.loop is not None and results.loop.declared == ("axis_expansion",)
    assert sums(results_folder) == before


def test_an_existing_folder_is_refused(results_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="exists; name another folder for the new results"):
        branch_results(results_folder, tmp_path)
