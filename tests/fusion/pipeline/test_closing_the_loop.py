"""The whole command on small campaigns: files in, results.json out, one undeclared effect each, and one campaign without."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion.pipeline.run import run_campaign
from fusion.products.store import read_dataset
from fusion.twin.instruments import simulate_campaign

#: 30 cycles and 6 targets, small frames and cells of 20 mm: a run takes a few seconds.
RECIPE = """\
[campaign]
seed = 12
[test]
cycles = 30
targets = 6
spacing_mm = 50
period_s = 180
[duty]
kind = "random"
mean_hold_min = 12
[laser]
noise_um = 0.3
[camera]
columns = 320
rows = 240
focal_px = 700.0
"""


def run(folder: Path, effect: str = "") -> tuple[dict[str, Any], Path]:
    """Simulate a campaign, run the command's work on its files, and read results.json."""
    (folder / "recipe.toml").write_text(RECIPE + effect)
    campaign = simulate_campaign(folder / "recipe.toml", folder / "campaign")
    campaign.write_text(campaign.read_text().replace('cell_size = "5 mm"', 'cell_size = "20 mm"'))
    run_campaign(campaign, folder / "results")
    return json.loads((folder / "results" / "results.json").read_text()), folder / "results"


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("dead_path", "amplitude_um = 1.2"),
        ("step_event", "amplitude_um = 0.8\nat_cycle = 14"),
        ("periodic_disturbance", "amplitude_um = 0.8\nperiod_min = 17.0"),
    ],
)
def test_an_undeclared_effect_is_named_from_the_files(name: str, parameters: str, tmp_path: Path) -> None:
    results, _ = run(tmp_path, f'[[effect]]\nname = "{name}"\n{parameters}\n')
    loop = results["loop"]
    assert [step["effect"] for step in loop["steps"]] == [name]
    assert loop["steps"][0]["p_value"] < 0.03
    # 30 cycles seal six, so the error on them is known to a tenth only.
    assert loop["rmse_final_um"] < 1.3 * loop["noise_floor_um"]
    if name == "step_event":
        assert loop["steps"][0]["event_cycle"] == 14
    if name == "periodic_disturbance":
        assert loop["steps"][0]["parameters"]["period_min"] == pytest.approx(17.0, rel=0.02)


def test_a_camera_step_is_taken_out_of_the_fields(tmp_path: Path) -> None:
    results, folder = run(tmp_path, '[[effect]]\nname = "camera_offset"\namplitude_K = 0.6\nat_cycle = 14\n')
    # It shows beside the table, before any drift is looked at: the loop has nothing left to find.
    (step,) = results["camera"]["steps"]
    assert step["step_K"]["value"] == pytest.approx(0.6, abs=0.05)
    assert results["loop"]["steps"] == []
    fields = read_dataset(folder / "fields.nc")
    np.testing.assert_allclose(fields["camera_correction"][:13], 0.0, atol=1e-9)
    np.testing.assert_allclose(fields["camera_correction"][13:], -step["step_K"]["value"], atol=0.05)
    # The field no longer jumps: its largest change between two cycles is that of a warming table.
    assert float(np.abs(fields["temperature_rise"].mean(["y", "x"]).diff("cycle")).max()) < 0.3


def test_nothing_is_added_where_nothing_is_missing(tmp_path: Path) -> None:
    results, folder = run(tmp_path)
    loop = results["loop"]
    assert loop["steps"] == [] and loop["verdict"] == "complete"
    assert loop["field_corrections"] == []
    expansion = loop["declared_coefficients"][0]
    assert (expansion["prior"], expansion["prior_u"]) == (11.7, 2.0)
    assert 0.0 < expansion["u"] < 2.0
    found = {one["effect"]: one for one in loop["identifiability"]}
    assert 0.0 < found["reversal_drift"]["detectable_um"] < found["thermal_lag"]["detectable_um"]
    assert "What this campaign can detect" in (folder / "report.html").read_text()
