"""Lies in a campaign folder, run by the pipeline: refused or doubted by name, never a confident wrong answer without a word."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from fusion.campaign.config import CampaignError
from fusion.consistency.checks import CODES, ContradictionError
from fusion.pipeline.run import run_campaign
from fusion.products.results import read_results
from fusion.report.terminal import summary_rows
from tests.fusion.consistency import lies


def test_a_sound_campaign_passes_every_check(results_folder: Path) -> None:
    inputs = read_results(results_folder).inputs
    assert inputs is not None and inputs.state == "sound"
    assert {check.code for check in inputs.checks} <= set(CODES)
    assert all(check.passed for check in inputs.checks)


@pytest.mark.parametrize(
    ("lie", "message"),
    [
        (lies.deviations_in_nm, "Check the units: deviations are read as µm and positions as mm"),
        (lies.drivers_of_another_day, "drivers.csv .* covers 0 % of the readings"),
    ],
)
def test_a_contradiction_is_refused_before_a_folder_is_made(
    copied: Path, tmp_path: Path, lie: Callable[[Path], None], message: str
) -> None:
    lie(copied)
    with pytest.raises(ContradictionError, match=message):
        run_campaign(copied / "campaign.toml", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("lie", "code"),
    [
        (lies.deviations_in_mm, "deviation_unit"),
        (lies.positions_in_inch, "travel"),
        (lies.inverted_signs, "axis_line"),
        (lies.copied_cycle, "copied_cycles"),
        (lies.new_datum, "datum"),
        (lies.drivers_end_early, "drivers_coverage"),
        (lies.emissivity_of_half, "material_rise"),
    ],
)
def test_a_doubt_is_named_first_and_makes_the_verdict_conditional(
    copied: Path, tmp_path: Path, lie: Callable[[Path], None], code: str
) -> None:
    lie(copied)
    results = run_campaign(copied / "campaign.toml", tmp_path / "out")
    assert results.inputs is not None and results.inputs.state == "doubted"
    assert code in [check.code for check in results.inputs.doubts]
    assert results.warnings[0].code.startswith("doubt_")
    name, text = summary_rows(results)[0]
    assert name == "inputs" and text.startswith("doubted: ")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Doubted input." in page and "Only if " in page
    conditional = {figure for check in results.inputs.doubts for figure in check.conditional}
    assert "causes" in conditional
    sizes = dict(summary_rows(results))["how much"]
    assert ("only if" in sizes.lower()) is ("positions" in conditional)


def test_a_doubt_can_be_accepted_and_an_unknown_one_is_refused(copied: Path, tmp_path: Path) -> None:
    lies.copied_cycle(copied)
    path = copied / "campaign.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text + '\n[accept]\ndoubts = ["copied_cycles"]\n', encoding="utf-8")
    results = run_campaign(path, tmp_path / "out")
    assert results.inputs is not None and results.inputs.state == "sound"
    assert results.inputs.accepted == ("copied_cycles",)
    path.write_text(text + '\n[accept]\ndoubts = ["weather"]\n', encoding="utf-8")
    with pytest.raises(
        CampaignError, match=r"accept\.doubts = 'weather': no such check; there are: deviation_magnitude"
    ):
        run_campaign(path, tmp_path / "other")


def test_one_error_of_reading_changes_neither_the_verdict_on_the_field_nor_the_causes(
    copied: Path, tmp_path: Path, results_folder: Path
) -> None:
    lies.one_gross_reading(copied)
    sound, spoilt = read_results(results_folder), run_campaign(copied / "campaign.toml", tmp_path / "out")
    assert sound.correlation is not None and spoilt.correlation is not None and sound.loop is not None
    assert spoilt.correlation.verdict == sound.correlation.verdict
    # One reading of 288 less; the p-values have a standard error of 0.016 from their 499 draws.
    assert spoilt.correlation.source.p_value == pytest.approx(sound.correlation.source.p_value, abs=0.06)
    assert spoilt.loop is not None
    assert [step.effect for step in spoilt.loop.steps] == [step.effect for step in sound.loop.steps]
    assert spoilt.loop.rmse_final_um == pytest.approx(sound.loop.rmse_final_um, rel=0.02)
    (notice,) = (warning for warning in spoilt.warnings if warning.code == "gross_readings")
    assert "cycle 9, position 5 (200 mm), positive approach" in notice.message and "left out" in notice.message
