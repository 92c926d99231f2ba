"""The thermal stage: notices about the camera, the clock offset of a moving table, and fields that keep the CF conventions."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from compliance_checker.runner import CheckSuite

from fusion.campaign.config import load_campaign
from fusion.campaign.inputs import read_source
from fusion.pipeline.consistency import check_plan
from fusion.pipeline.thermal import clock_notices, pixel_notices, reduce_thermography
from fusion.products.progress import silent
from fusion.products.store import read_dataset
from fusion.twin.instruments import simulate_campaign
from thermography.registration.clock_offset import ClockOffset
from thermography.registration.evidence import RegistrationError


def test_bad_pixels_are_counted_by_kind(rng: np.random.Generator) -> None:
    counts = np.round(16000 + 2.0 * np.arange(80) + rng.normal(0, 8, (24, 60, 80))).astype(np.uint16)
    assert pixel_notices(counts) == []
    counts[:, 20, 30] = 16060
    counts[:, 40, 50] += 900
    counts[:, 10, 70] = 16140 + np.round(rng.normal(0, 400, 24)).astype(np.int64)
    (notice,) = pixel_notices(counts)
    assert notice.code == "bad_pixels"
    assert notice.message.startswith("3 pixels do not follow their neighbours (1 dead, ")
    assert "off its neighbours" in notice.message
    assert notice.message.endswith("1 noisy); they are included in the cell averages.")


def test_the_offset_of_a_periodic_test_is_said_as_an_assumption() -> None:
    clock = ClockOffset(37.0, 0.1, 0.0, 0.0, 0.0, 300.0, 0.1, 60)
    assert clock_notices(clock) == []
    (notice,) = clock_notices(replace(clock, rivals_s=(-215.0, 289.0)))
    assert notice.code == "clock_offset_periodic"
    assert notice.message.startswith(
        "The motion repeats: clock offsets of -215.0 s; 289.0 s fit about as well as 37.0 s"
    )


def test_fields_pass_the_cf_checker(results_folder: Path) -> None:
    """CF-1.11 without an error or a warning; deviations and fusion carry the same global attributes."""
    CheckSuite.load_all_available_checkers()
    suite = CheckSuite()
    dataset = suite.load_dataset(str(results_folder / "fields.nc"))
    groups, errors = suite.run_all(dataset, ["cf:1.11"])["cf:1.11"]
    assert errors == {}
    assert [message for group in groups if group.value[0] < group.value[1] for message in group.msgs] == []
    for name in ("fields", "deviations", "fusion"):
        product = read_dataset(results_folder / f"{name}.nc")
        assert product.attrs["Conventions"] == "CF-1.11" and product.attrs["title"] == "Small campaign"
        assert set(json.loads(product.attrs["provenance"])) == {"software", "versions", "inputs"}
        assert all({"long_name", "standard_name"} & set(variable.attrs) for variable in product.variables.values())


def test_the_clock_of_a_camera_that_sees_the_table_move_is_found(tmp_path: Path) -> None:
    """The clock is 37 s ahead and nobody says so; 13 s between frames do not divide the cycle, 0.2 s is a tenth of the dwell."""
    (tmp_path / "recipe.toml").write_text(
        "[campaign]\nseed = 3\n[test]\ncycles = 12\ntargets = 7\nspacing_mm = 40\nperiod_s = 200\n"
        '[camera]\ntable = "moving"\nfile = "seq"\ncolumns = 320\nrows = 240\nfocal_px = 600.0\ndistance_mm = 1900.0\n'
        "frame_interval_s = 13.0\nclock_offset_s = 37.0\nstate_clock_offset = false\n"
    )
    campaign = simulate_campaign(tmp_path / "recipe.toml", tmp_path / "campaign")
    campaign.write_text(campaign.read_text().replace('cell_size = "5 mm"', 'cell_size = "20 mm"'))
    outcome = reduce_thermography(
        read_source(load_campaign(campaign)), checkpoint=tmp_path / "cycles", scheduler=None, report=silent
    )
    assert outcome.parts["alignment"]["clock_offset_s"]["value"] == pytest.approx(37.0, abs=0.2)
    place = outcome.dataset["table_position"]
    assert float(place.max() - place.min()) == pytest.approx(240.0, abs=0.5)
    assert {"time", "frame_time"} <= set(outcome.dataset.coords)


def test_points_picked_by_hand_and_a_calibrated_lens_serve_a_campaign(tmp_path: Path) -> None:
    """A table without painted discs, and the lens that the recipe gave the camera; a wrong list is refused by its name."""
    (tmp_path / "recipe.toml").write_text(
        "[campaign]\nseed = 4\n[plan]\nhint_error_px = 0.7\n[test]\ncycles = 12\ntargets = 5\nperiod_s = 120\n"
        '[camera]\nfile = "seq"\ncolumns = 320\nrows = 240\nfocal_px = 600.0\ndistance_mm = 1500.0\nframes_per_cycle = 1\n'
    )
    campaign = simulate_campaign(tmp_path / "recipe.toml", tmp_path / "campaign")
    text = campaign.read_text().replace('cell_size = "5 mm"', 'cell_size = "20 mm"')
    campaign.write_text(text.replace("[thermography]", '[thermography]\nlens = "lens.json"'))
    (campaign.parent / "lens.json").write_text(
        '{"K": [[600, 0, 159.5], [0, 600, 119.5], [0, 0, 1]], "D": [-0.3, 0, 0, 0], "image_width": 320, "image_height": 240}'
    )
    fiducials = pd.read_csv(campaign.parent / "fiducials.csv")

    def registered(table: pd.DataFrame) -> dict[str, Any]:
        table.to_csv(campaign.parent / "fiducials.csv", index=False)
        source = read_source(load_campaign(campaign))
        outcome = reduce_thermography(source, checkpoint=tmp_path / "cycles", scheduler=None, report=silent)
        part: dict[str, Any] = outcome.parts["registration"]
        assert [check.code for check in check_plan(source, part) if not check.passed] == []
        return part

    by_discs = registered(fiducials)
    assert by_discs["model"] == "calibrated lens + homography"
    assert max(by_discs["rms_mm"], by_discs["position_u_mm"]) < 0.1
    # Places as read off a screen: whole pixels with the twin's error of a hint, 5 mm each.
    by_points = registered(fiducials.assign(diameter_mm=np.nan))
    assert by_discs["position_u_mm"] < 0.1 * by_points["position_u_mm"]
    with pytest.raises(RegistrationError, match=r"^fiducials\.csv: the table cannot be located: places and diameters"):
        registered(fiducials.assign(diameter_mm=2 * fiducials["diameter_mm"]))
