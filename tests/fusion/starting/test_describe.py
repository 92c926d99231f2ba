"""Descriptions of every kind of file that a run reads."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion.campaign.config import CampaignError
from fusion.starting.describe import describe_file
from fusion.starting.kinds import recognise

ENVIRONMENT = "time,air_temperature_degC,air_pressure_hPa,relative_humidity_percent,material_temperature_degC"


def described(path: Path) -> list[str]:
    return describe_file(recognise(path))


def test_a_log_is_described_with_its_range_and_its_zone(tmp_path: Path) -> None:
    path = tmp_path / "environment.csv"
    for zone, words in (("Z", "UTC in the file"), ("", "no zone in the file: taken as UTC")):
        rows = [f"2026-03-09T06:{minute:02d}:00{zone},{20 + minute / 10},1000,45,21" for minute in range(10)]
        path.write_text("\n".join([ENVIRONMENT, *rows]) + "\n")
        lines = described(path)
        assert lines[0] == f"{path}: environment, 10 rows, 2026-03-09 06:00 UTC to 2026-03-09 06:09 UTC, {words}"
        assert "  air_temperature 20.00 to 20.90 °C" in lines


def test_the_files_of_a_campaign(campaign_folder: Path) -> None:
    campaign = described(campaign_folder / "campaign.toml")
    assert campaign[0].endswith("campaign, Small campaign") and "thermofuse check" in campaign[-1]
    assert described(campaign_folder / "fiducials.csv")[0].startswith(
        f"{campaign_folder / 'fiducials.csv'}: fiducials, 12 discs, x 40"
    )
    assert "  duty" in described(campaign_folder / "drivers.csv")[1]
    laser = described(campaign_folder / "laser.csv")
    assert "deviations, 24 cycles, 6 targets from 0 to 250 mm, 288 of 288 readings" in laser[0]
    assert laser[2].endswith("times recorded, UTC in the file")


def test_regions_lenses_recipes_and_records(tmp_path: Path) -> None:
    (tmp_path / "regions.csv").write_text("name,x_mm,y_mm\nmotor,0,0\nmotor,9,0\nmotor,9,9\n")
    assert described(tmp_path / "regions.csv") == [f"{tmp_path / 'regions.csv'}: 1 region of the plan: motor"]
    (tmp_path / "lens.json").write_text(
        '{"camera_matrix": [[900,0,320],[0,900,240],[0,0,1]], "distortion_coefficients": [0.1,0,0,0]}'
    )
    assert described(tmp_path / "lens.json")[0].endswith("lens, focal length 900.0 px, centre 320.0, 240.0 px")
    (tmp_path / "recipe.toml").write_text('[campaign]\ntitle = "A"\n[test]\ncycles = 3\n')
    assert described(tmp_path / "recipe.toml")[0].endswith("recipe of a simulation, A")
    (tmp_path / "run.csv").write_text("time [s],t1 [degC],ch1 [um],speed [1/min]\n0,20,0,1\n1,20,0,1\n")
    assert described(tmp_path / "run.csv") == [
        f"{tmp_path / 'run.csv'}: record, 2 rows, time in the column time [s]",
        "  1 temperature: t1 [degC]",
        "  1 displacement: ch1 [um]",
        "  1 other column: speed [1/min]",
    ]


def test_a_campaign_with_a_fault_is_refused_with_its_line(copied: Path) -> None:
    file = copied / "campaign.toml"
    file.write_text(file.read_text().replace('"20 mm"', "20"))
    with pytest.raises(CampaignError, match=r"line 17: plan.cell_size = 20"):
        described(file)
