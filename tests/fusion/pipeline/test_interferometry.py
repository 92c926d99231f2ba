"""The stage of the readings: parts of the results agree with the product, omissions are noted with their cost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import load_campaign
from fusion.campaign.inputs import read_source
from fusion.pipeline.interferometry import align_recordings, by_direction, evaluate_interferometry
from fusion.products.results import Notice
from fusion.products.store import read_dataset
from fusion.twin import simulate
from fusion.twin.recipe_file import read_recipe
from fusion.twin.truth import deviations_of
from interferometry.drift.estimate import estimate_drift


def test_gaps_and_outliers_are_noted_with_what_they_cost(copied: Path) -> None:
    lines = (copied / "laser.csv").read_text().splitlines()
    head, value = lines[30].rsplit(",", 1)
    lines[30] = f"{head},{float(value) + 40.0}"
    lines[60] = f"{lines[60].rsplit(',', 1)[0]},"
    (copied / "laser.csv").write_text("\n".join(lines) + "\n")
    outcome = evaluate_interferometry(read_source(load_campaign(copied / "campaign.toml")))
    notices = {notice.code: notice for notice in outcome.notices}
    assert notices["outliers"].message.startswith("1 outlier down-weighted in the joint estimate: cycle ")
    assert notices["readings_missing"].message.startswith("1 reading of 288 missing, in 1 cycle: ")
    # Nothing has to be done about a gap.
    assert notices["readings_missing"].remedy == ""
    assert 0.0 < (notices["readings_missing"].effect_um or 0.0) < 0.1


def test_parts_agree_with_the_product(campaign_folder: Path) -> None:
    outcome = evaluate_interferometry(read_source(load_campaign(campaign_folder / "campaign.toml")))
    assert outcome.parts["iso230"]["window"] == "cycles 1 to 5"
    assert outcome.parts["iso230"]["A_um"]["value"] == pytest.approx(float(outcome.dataset["iso_A"][0]))
    profile = outcome.dataset["drift_profile"]
    assert by_direction(profile)["negative"] == profile.sel(direction="negative").values.tolist()
    time = outcome.dataset["time"].values
    told = outcome.parts["time"]
    assert [np.datetime64(told[name][:-1]) for name in ("first", "last")] == [
        one.astype("datetime64[s]") for one in (time.min(), time.max())
    ]
    assert told["zone"] is None
    course = outcome.dataset["drift_drift"].mean("direction")
    drift = outcome.parts["drift"]
    np.testing.assert_allclose(drift["range_um"], course.max("cycle") - course.min("cycle"))
    assert all(0.0 < u < one for u, one in zip(drift["range_u_um"], drift["range_um"], strict=True))
    assert drift["position_mm"] == outcome.dataset["position"].values.tolist()


def test_a_scatter_that_the_drift_hides_is_named_and_no_other(copied: Path) -> None:
    assert not any(notice.code == "scatter_undetermined" for notice in notices_of(copied))
    head, *lines = (copied / "laser.csv").read_text().splitlines()
    column = head.split(",").index("deviation_um")
    rows = sorted((line.split(",") for line in lines), key=lambda row: row[head.split(",").index("time")])
    walk = np.cumsum(np.random.default_rng(3).normal(0.0, 1.0, len(rows)))
    noise = np.random.default_rng(4).normal(0.0, 1e-4, len(rows))
    for row, value in zip(rows, walk + noise, strict=True):
        row[column] = f"{value:.6f}"
    (copied / "laser.csv").write_text("\n".join([head, *(",".join(row) for row in rows)]) + "\n")
    (notice,) = [one for one in notices_of(copied) if one.code == "scatter_undetermined"]
    assert "the search for the variances ended at its limit. The scatter of " in notice.message
    assert notice.remedy.startswith(
        "Let the machine come to rest before the test, or read the positions in quicker succession"
    )


def test_the_scatter_of_the_demo_is_determined_also_with_a_quieter_laser() -> None:
    recipe = read_recipe(Path("data/demo.toml"))
    for noise_um in (recipe.laser.noise_um, 0.1):
        estimated = estimate_drift(deviations_of(simulate(recipe.vary(laser={"noise_um": noise_um}))))
        assert estimated.attrs["scatter_undetermined"] == 0


def notices_of(campaign: Path) -> tuple[Notice, ...]:
    return evaluate_interferometry(read_source(load_campaign(campaign / "campaign.toml"))).notices


def test_readings_outside_the_frames_are_counted(campaign_folder: Path, results_folder: Path) -> None:
    source = read_source(load_campaign(campaign_folder / "campaign.toml"))
    fields = read_dataset(results_folder / "fields.nc")
    fused, (notice,) = align_recordings(source, fields, read_dataset(results_folder / "deviations.nc"))
    outside = int(np.count_nonzero(~fused["inside_frames"].values))
    assert notice.message.startswith(f"{outside} readings outside the frames' time, in 1 cycle (1)")
    # A cycle out of 24 is no reason to film otherwise.
    assert notice.remedy == ""
    fewer = fields.isel(time=slice(3, None))
    _, (many,) = align_recordings(source, fewer, read_dataset(results_folder / "deviations.nc"))
    assert many.remedy.startswith("Start the camera before the first cycle")


def test_an_error_of_reading_is_left_out_of_the_comparison_with_the_field_and_named(
    campaign_folder: Path, results_folder: Path
) -> None:
    source = read_source(load_campaign(campaign_folder / "campaign.toml"))
    fields, deviations = (read_dataset(results_folder / f"{name}.nc") for name in ("fields", "deviations"))
    sound, _ = align_recordings(source, fields, deviations)
    spoilt = deviations.copy(deep=True)
    spoilt["deviation"][10, 1, 3] = 1e6
    spoilt["drift_standardised"][10, 1, 3] = np.inf
    fused, notices = align_recordings(source, fields, spoilt)
    message = next(notice.message for notice in notices if notice.code == "gross_readings")
    assert message.startswith(
        "1 reading more than ten standard deviations of their position off, by up to 1e+06 µm: cycle 11, position 4 (150 mm), negative "
        "approach, 2026-03-09 07:01 UTC;"
    )
    # Everything else is what it was: what follows cannot change by the size of the error.
    assert np.isnan(fused["deviation"].values[10, 1, 3])
    sound["deviation"][10, 1, 3] = np.nan
    np.testing.assert_array_equal(fused["deviation"], sound["deviation"])


def test_a_gap_between_the_frames_is_named_with_the_cycles_that_have_none(
    campaign_folder: Path, results_folder: Path
) -> None:
    source = read_source(load_campaign(campaign_folder / "campaign.toml"))
    fields = read_dataset(results_folder / "fields.nc")
    fields = fields.isel(time=np.delete(np.arange(fields.sizes["time"]), np.arange(4, 9)))
    fields["temperature"][4:9] = np.nan
    _, notices = align_recordings(source, fields, evaluate_interferometry(source).dataset)
    (gap,) = (notice for notice in notices if notice.code == "frames_gaps")
    assert gap.message.startswith("1 gap between the frames: 18 min from ")
    assert "; cycles without a frame: 5; 6; 7; 8; 9. The field of " in gap.message
