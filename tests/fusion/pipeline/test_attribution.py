"""What the command makes of drift and field: regions, hotspots, randomised duty, and the words for them."""

import shutil

import numpy as np
import pytest
import xarray as xr

from fusion.campaign.config import load_campaign
from fusion.campaign.inputs import read_source
from fusion.pipeline.attribution import correlate_field, describe_hotspots
from fusion.pipeline.drift_model import join_fusion
from fusion.pipeline.positioning import align_recordings
from fusion.report.campaign import describe_correlation
from fusion.results.progress import silent
from fusion.results.results import SCHEMA_VERSION, Results, assemble
from fusion.results.store import plain, read_dataset, read_grouped
from fusion.twin.machine import duty_levels
from fusion.twin.recipe import Duty
from tests.fusion.campaign_parts import change


@pytest.fixture(scope="module")
def campaign(campaign_folder, tmp_path_factory):
    """The small campaign with a load that was switched at random, and one region of its own."""
    folder = shutil.copytree(campaign_folder, tmp_path_factory.mktemp("switched") / "campaign")
    path = folder / "drivers.csv"
    rows = [line.split(",") for line in path.read_text().splitlines()]
    seconds = 60.0 * np.arange(len(rows) - 1)
    levels = duty_levels(Duty("randomised", mean_hold_min=10.0, least_hold_min=3.0), seconds, 5)
    lines = [f"{row[0]},{3000 * level:.0f}" for row, level in zip(rows[1:], levels, strict=True)]
    path.write_text("\n".join(["time,spindle [1/min]", *lines]) + "\n")
    (folder / "regions.csv").write_text("name,x_mm,y_mm\nmotor,100,20\nmotor,300,20\nmotor,300,160\nmotor,100,160\n")
    toml = change(folder / "campaign.toml", 'fiducials = "fid', 'regions = "regions.csv"\nfiducials = "fid')
    law = 'file = "drivers.csv"\nrandomised = ["spindle [1/min]"]\nmean_dwell = "10 min"\nleast_dwell = "3 min"'
    change(toml, 'file = "drivers.csv"', law)
    return folder


@pytest.fixture(scope="module")
def outcome(campaign, results_folder):
    source = read_source(load_campaign(campaign / "campaign.toml"))
    fields = read_dataset(results_folder / "fields.nc")
    fused, _ = align_recordings(source, fields, read_grouped(results_folder / "deviations.nc"))
    found = correlate_field(source, fields, fused, report=silent)
    return found.dataset, found.parts, fused


def test_the_part_of_the_results_keeps_the_schema(outcome):
    _, parts, _ = outcome
    document = {"schema": SCHEMA_VERSION, "campaign": "x", "warnings": [], **plain(parts)}
    Results.model_validate(document)


def test_regions_and_hotspots_are_tested_by_name(outcome):
    maps, parts, _ = outcome
    names = [one.name for one in parts.correlation.regions]
    assert names[0] == "motor"
    assert names[1:] == [f"hotspot {k}" for k in range(1, len(names))]
    assert set(parts.correlation.regions[0].parts) == {"common", "proportional", "reversal", "joint"}
    assert maps["target_regions/p_value"].sizes == {"series": 12, "region": len(names)}
    assert len(parts.hotspots) >= len(names) - 1


def test_an_object_and_an_unnamed_surface_are_no_hotspots(results_folder):
    fields = read_dataset(results_folder / "fields.nc").load()
    before = describe_hotspots(fields)
    assert before[0].x_u_mm > 0 and before[0].onset_time is not None and before[0].end_cycle is None
    near = np.hypot(fields["x"] - 60.0, fields["y"] - 130.0) < 15.0
    fields["temperature_rise"] = fields["temperature_rise"] + 5.0 * near * (fields["cycle"] > 6)
    assert any(abs(spot.x_mm - 60.0) < 20.0 and abs(spot.y_mm - 130.0) < 20.0 for spot in describe_hotspots(fields))
    unnamed = fields.assign_attrs(unnamed_surfaces='[{"x_mm": 60.0, "y_mm": 130.0, "size_mm": [50.0, 40.0]}]')
    assert not any(np.hypot(spot.x_mm - 60.0, spot.y_mm - 130.0) < 42.0 for spot in describe_hotspots(unnamed))
    hidden = xr.where(near & (fields["cycle"] > 6), 64, 0).transpose("cycle", "y", "x").astype(np.uint8)
    fields["quality_flag"] = hidden
    after = describe_hotspots(fields)
    assert not any(abs(spot.x_mm - 60.0) < 20.0 and abs(spot.y_mm - 130.0) < 20.0 for spot in after)
    # Cells by clipped ones: the source may be hotter there.
    late = fields["cycle"] > 6
    around = np.hypot(fields["x"] - 60.0, fields["y"] - 130.0) < 45.0
    fields["temperature_rise"] = (fields["temperature_rise"] + 5.0 * around * late).where(~(near & late))
    fields["quality_flag"] = xr.where(near & late, 128, 0).transpose("cycle", "y", "x").astype(np.uint8)
    beside = [spot for spot in describe_hotspots(fields) if np.hypot(spot.x_mm - 60.0, spot.y_mm - 130.0) < 45.0]
    assert beside and all(spot.masked for spot in beside)


def test_the_switched_load_gets_its_own_verdict(outcome):
    _, parts, _ = outcome
    (spindle,) = parts.correlation.randomised_duty
    assert spindle.name == "spindle"
    # The log was replaced by a schedule that has nothing to do with the drift.
    assert spindle.p_value > 0.05 and spindle.cause is False


def test_the_report_says_it_in_words(outcome):
    maps, parts, fused = outcome
    whole = join_fusion(fused, fused, maps, xr.Dataset())
    xr.testing.assert_equal(whole["correlation/duty"].to_dataset(inherit=False), maps["duty"].to_dataset(inherit=False))
    assert whole["correlation"].attrs["verdict"] == maps.attrs["verdict"]
    results = assemble("x", parts, [])
    said = describe_correlation(whole, results, None)
    assert said["headline"] and said["maps"][0]["name"] == "cells"
    assert results.correlation.randomised_duty is not None
    assert [(load.name, load.cause) for load in results.correlation.randomised_duty] == [("spindle", False)]


def test_the_twin_switches_by_the_law_that_it_states():
    seconds = 20.0 * np.arange(120_000)
    levels = duty_levels(Duty("randomised", mean_hold_min=30.0, least_hold_min=5.0), seconds, 1)
    holds = np.diff(seconds[np.flatnonzero(np.diff(levels))])
    assert set(np.unique(levels)) == {0.0, 1.0}
    assert holds.min() >= 300.0
    # About 1,300 holds of spread 25 min: standard error 0.7 min; 4 sigma.
    assert holds.mean() / 60.0 == pytest.approx(30.0, abs=2.8)


def test_a_very_long_test_is_correlated_by_means_of_its_cycles(campaign, results_folder, outcome, monkeypatch):
    source = read_source(load_campaign(campaign / "campaign.toml"))
    fields = read_dataset(results_folder / "fields.nc")
    monkeypatch.setattr("fusion.pipeline.positioning.MOST_CYCLES", 12)
    found = correlate_field(source, fields, outcome[2], report=silent)
    (notice,) = found.notices
    assert notice.code == "cycles_averaged" and "(12 of 24)" in notice.message
    parts = [one.name for one in found.parts.correlation.regions]
    assert parts == [one.name for one in outcome[1].correlation.regions]
