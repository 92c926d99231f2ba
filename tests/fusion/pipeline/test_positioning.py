"""The stage of the readings: parts agree with the product, omissions have their cost, and positions that stand out have a cause or none."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from fusion.analysis.diagnosis.diagnose import Diagnosis
from fusion.analysis.levels import ENTRY_LEVEL, REMAINDER_LEVEL
from fusion.campaign.config import load_campaign
from fusion.campaign.inputs import Source, read_source
from fusion.pipeline import positioning as module
from fusion.pipeline.iso230 import read_test
from fusion.pipeline.positioning import (
    MOST_TARGETS,
    align_recordings,
    average_cycles,
    by_direction,
    choose_targets,
    diagnose_positions,
    diagnosed,
    evaluate_interferometry,
    insufficient_for_correlation,
    insufficient_for_model,
    sites_of,
)
from fusion.report.wording import drift_extremes, drift_size
from fusion.results.axis import Evidence
from fusion.results.results import Notice
from fusion.results.store import read_product
from fusion.twin import simulate
from fusion.twin.instruments import deviations_of
from fusion.twin.recipe_file import read_recipe
from interferometry.anomalies import Anomaly
from interferometry.drift.estimate import estimate_drift
from tests.fusion.campaign_parts import write_laser


@pytest.fixture
def aligned(campaign_folder, results_folder):
    """Inputs, fields and deviations of the small campaign."""
    fields, deviations = (read_product(results_folder, name) for name in ("fields", "deviations"))
    source = read_source(load_campaign(campaign_folder / "campaign.toml"))
    assert isinstance(source, Source)
    return source, fields, deviations


def test_gaps_and_outliers_are_noted_with_what_they_cost(copied):
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


def test_digits_that_hide_the_scatter_leave_the_values_of_the_standard(copied):
    """A dial indicator of 10 um shows every cycle alike: nothing to weight readings by, but a sound test."""
    table = pd.read_csv(copied / "laser.csv")
    table["deviation_um"] = 10.0 * table["target"].round()
    table.to_csv(copied / "laser.csv", index=False)
    outcome = evaluate_interferometry(read_source(load_campaign(copied / "campaign.toml")))
    assert "no_scatter" in {notice.code for notice in outcome.notices} and outcome.parts.drift is None
    assert outcome.parts.iso230.A_um.value == pytest.approx(50.0)
    test = read_test(copied / "laser.csv", None)
    assert test.part.R_um.value == 0.0 and any("repeat exactly" in remark for remark in test.remarks)


def test_parts_agree_with_the_product(campaign_folder):
    outcome = evaluate_interferometry(read_source(load_campaign(campaign_folder / "campaign.toml")))
    standard = outcome.parts.iso230
    assert standard.first.cycles == (1, 2, 3, 4, 5) and standard.cycles[0] > 12
    for found, name in ((standard.first, "iso_A"), (standard, "quoted_A")):
        assert found.A_um.value == pytest.approx(float(np.atleast_1d(outcome.dataset[name])[0]))
    profile = outcome.dataset["estimate_profile"]
    assert by_direction(profile).negative == tuple(profile.sel(direction="negative").values)
    time = outcome.dataset["time"].values
    told = outcome.parts.time
    for text, one in ((told.first, time.min()), (told.last, time.max())):
        assert np.datetime64(text[:-1]) == one.astype("datetime64[s]")
    assert told.zone is None
    course = outcome.dataset["estimate_drift"].mean("direction")
    drift = outcome.parts.drift
    np.testing.assert_allclose(drift.range_um, course.max("cycle") - course.min("cycle"))
    assert all(0.0 < u < one for u, one in zip(drift.range_u_um, drift.range_um, strict=True))
    assert drift.position_mm == tuple(outcome.dataset["position"].values)


def test_a_drift_of_nothing_is_known_no_better_than_the_readings_are(tmp_path):
    """White noise: the change of the mean from one half of the test to the other has 2 s / sqrt(n) of the readings at a position."""
    path, rng = write_laser(tmp_path / "test", 12, 5), np.random.default_rng(5)
    table = pd.read_csv(path.with_name("laser.csv"))
    still = table.assign(deviation_um=table["target"] + rng.normal(0.0, 0.25, len(table)))
    still.to_csv(path.with_name("laser.csv"), index=False)
    outcome = evaluate_interferometry(read_source(load_campaign(path)))
    scatter = float(outcome.dataset["estimate_sigma"])
    # 120 readings less their means know a standard deviation to 7 %.
    assert scatter == pytest.approx(0.25, rel=0.2)
    assert min(outcome.parts.drift.range_u_um) >= 2.0 * scatter / np.sqrt(24) * (1.0 - 1e-12)
    largest, _ = drift_extremes(outcome.parts.drift)
    assert largest.negligible and drift_size(largest).startswith("below 0.")


def test_a_scatter_that_the_drift_hides_is_named_and_no_other(copied):
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
    assert "cannot be told from none. The scatter of " in notice.message
    assert notice.remedy.startswith("Let the machine come to rest before the test")


def test_the_scatter_of_the_demo_is_determined_also_with_a_quieter_laser():
    recipe = read_recipe(Path("data/recipes/demo.toml"))
    for noise_um in (recipe.laser.noise_um, 0.1):
        estimated = estimate_drift(deviations_of(simulate(recipe.vary(laser={"noise_um": noise_um}))))
        assert estimated.attrs["scatter_undetermined"] == 0


def notices_of(campaign: Path) -> tuple[Notice, ...]:
    return evaluate_interferometry(read_source(load_campaign(campaign / "campaign.toml"))).notices


def test_readings_outside_the_frames_are_counted(aligned):
    source, fields, deviations = aligned
    fused, (notice,) = align_recordings(source, fields, deviations)
    outside = int(np.count_nonzero(~fused["inside_frames"].values))
    assert notice.message.startswith(f"{outside} readings outside the frames' time, in 1 cycle (1)")
    # A cycle out of 24 is no reason to film otherwise.
    assert notice.remedy == ""
    _, (many,) = align_recordings(source, fields.isel(time=slice(3, None)), deviations)
    assert many.remedy.startswith("Start the camera before the first cycle")


def test_an_error_of_reading_is_left_out_of_the_comparison_with_the_field_and_named(aligned):
    source, fields, deviations = aligned
    sound, _ = align_recordings(source, fields, deviations)
    spoilt = deviations.copy(deep=True)
    spoilt["deviation"][10, 1, 3] = 1e6
    spoilt["estimate_standardised"][10, 1, 3] = np.inf
    fused, notices = align_recordings(source, fields, spoilt)
    message = next(notice.message for notice in notices if notice.code == "gross_readings")
    assert message.startswith("1 reading more than ten standard deviations of their position off, by up to 1e+06 µm: ")
    assert "cycle 11, position 4 (150 mm), negative approach, 2026-03-09 07:01 UTC;" in message
    # Everything else is what it was: what follows cannot change by the size of the error.
    assert np.isnan(fused["deviation"].values[10, 1, 3])
    sound["deviation"][10, 1, 3] = np.nan
    np.testing.assert_array_equal(fused["deviation"], sound["deviation"])


def test_a_gap_between_the_frames_is_named_with_the_cycles_that_have_none(aligned):
    source, fields, _ = aligned
    fields = fields.isel(time=np.delete(np.arange(fields.sizes["time"]), np.arange(4, 9)))
    fields["temperature"][4:9] = np.nan
    _, notices = align_recordings(source, fields, evaluate_interferometry(source).dataset)
    (gap,) = (notice for notice in notices if notice.code == "frames_gaps")
    assert gap.message.startswith("1 gap between the frames: 18 min from ")
    assert "; cycles without a frame: 5; 6; 7; 8; 9. The field of " in gap.message


def anomaly(target: int = 3, direction: str = "positive", *, p_value: float = 0.01, stands_out: bool = True) -> Anomaly:
    return Anomaly(
        target, direction, kind="scatter", p_value=p_value, scatter_um=0.8, extra_um=0.6, stands_out=stands_out
    )


def diagnosis(cause: str = "structural") -> Diagnosis:
    shown = {name: 0.0 for name, field in Evidence.model_fields.items() if field.is_required()}
    evidence = {**shown, "probability_structural": 0.9, "step_cycle": 4}
    for stated in ("kind", "extra_um", "probability", "support", "against", "check"):
        evidence.pop(stated, None)
    return Diagnosis(3, "positive", cause, 0.9, evidence, ("it scatters",), ("it is alone",), "Look at the guide.")


def test_sites_are_set_aside_for_at_most_a_quarter_of_the_targets():
    def found(*places):
        return [diagnosed(anomaly(*place), diagnosis(), position_mm=0.0) for place in places]

    assert sites_of(found((2,), (5,)), 8) == [(2, "positive"), (5, "positive")]
    assert sites_of(found((2,), (5,)), 7) == sites_of([], 4) == []
    # A target counts once, and both directions are two sites.
    both = [(2, "positive"), (2, "negative"), (2, "negative")]
    assert sites_of(found((2, "both"), (2, "negative")), 4) == both


def test_a_position_is_written_with_its_evidence():
    one = diagnosed(anomaly(), diagnosis(), position_mm=50.0)
    assert (one.target, one.position_mm, one.direction, one.cause) == (3, 50.0, "positive", "structural")
    assert (one.p_value, one.p_resolution, one.scatter_um) == (0.01, 0.0, 0.8)
    evidence = one.evidence
    assert (evidence.kind, evidence.extra_um, evidence.probability, evidence.step_cycle) == ("scatter", 0.6, 0.9, 4)
    assert (evidence.support, evidence.against) == (("it scatters",), ("it is alone",))
    assert evidence.check == "Look at the guide." and evidence.probability_structural == 0.9


def test_what_the_model_explains_is_taken_out_before_positions_are_judged(monkeypatch):
    dims = ("cycle", "direction", "target")
    deviation = xr.DataArray(np.arange(12.0).reshape(3, 2, 2), dims=dims, attrs={"units": "um"})
    explained = xr.full_like(deviation, 2.0)
    explained[0, 0, 0] = np.nan
    fused, deviations = xr.Dataset({"deviation": deviation}), xr.Dataset({"deviation": deviation})
    expected = deviation.values - explained.values
    judged = []

    def detect(cleaned, drift, *, level, permutations):
        judged.append(cleaned["deviation"])
        assert drift == "drift of what is left"
        # Whatever a run may state of a campaign in which nothing is missing: an effect, a remainder or an anomaly.
        assert level + ENTRY_LEVEL + REMAINDER_LEVEL == pytest.approx(0.05)
        # The rarest kind has a tenth of the probability, and must reach it.
        assert permutations + 1 >= 10 / level
        return [anomaly(1), anomaly(2, stands_out=False), anomaly(3)]

    def diagnose(cleaned, anomalies):
        judged.append(cleaned["deviation"])
        return [diagnosis() for _ in anomalies]

    monkeypatch.setattr(module, "estimate_drift", lambda cleaned: "drift of what is left")
    monkeypatch.setattr(module, "detect_anomalies", detect)
    monkeypatch.setattr(module, "diagnose", diagnose)
    positions = deviations.assign_coords(target=[1, 3], position=("target", [0.0, 50.0]))
    told = diagnose_positions(fused, positions, explained)
    for values in judged:
        np.testing.assert_array_equal(values, expected)
        assert values.attrs == {"units": "um"}
    # Scatter that is naturally unequal is no anomaly.
    assert [(one.target, one.position_mm, one.cause) for one in told] == [
        (1, 0.0, "structural"),
        (3, 50.0, "structural"),
    ]
    np.testing.assert_array_equal(fused["deviation"], np.arange(12.0).reshape(3, 2, 2))


def deviations(cycles: int, targets: int) -> xr.Dataset:
    return xr.Dataset(coords={"cycle": np.arange(cycles), "target": np.arange(targets)})


def test_small_tests_are_told_what_model_and_correlation_would_need():
    assert list(insufficient_for_model(deviations(12, 3))) == []
    for cycles, targets in ((5, 11), (12, 2)):
        (notice,) = insufficient_for_model(deviations(cycles, targets))
        assert notice.message.startswith(f"{cycles} cycles at {targets} targets: ISO 230-2, profile, scatter and drift")
        assert "at least 12 cycles (better 50) at 3 targets" in notice.message
    few, enough = (xr.Dataset(coords={"time": np.arange(count)}) for count in (11, 12))
    assert next(insufficient_for_correlation(few)).message.startswith("11 frames: fields and hotspots are evaluated")
    assert list(insufficient_for_correlation(enough)) == []


def test_very_many_targets_are_thinned_evenly_and_keep_both_ends():
    few = deviations(12, MOST_TARGETS).assign(position=("target", np.arange(MOST_TARGETS)))
    assert choose_targets(few) == (few, [])
    many = deviations(12, 400).assign(position=("target", np.arange(400.0)[::-1]))
    chosen, (notice,) = choose_targets(many)
    assert chosen.sizes["target"] == MOST_TARGETS
    assert chosen["position"].values.max() == 399.0 and chosen["position"].values.min() == 0.0
    assert np.abs(np.diff(chosen["position"].values)).max() <= 7.0
    assert "64 of the 400 positions" in notice.message


def test_cycles_and_frames_of_a_very_long_test_are_averaged(monkeypatch):
    start = np.datetime64("2026-03-09T06:30", "ns")
    seconds = 10.0 * np.arange(24.0).reshape(12, 1, 2)
    deviation = seconds / 10.0
    deviation[0, 0, 1], deviation[3:6, 0, 0] = np.nan, np.nan
    fused = xr.Dataset(
        {
            "deviation": (("cycle", "direction", "target"), deviation, {"units": "um"}),
            "time": (("cycle", "direction", "target"), start + (1e9 * seconds).astype("timedelta64[ns]")),
            "position": ("target", [0.0, 50.0]),
        },
        coords={"cycle": np.arange(1, 13), "direction": ["positive"], "target": [1, 2]},
    )
    field = xr.DataArray(
        np.arange(24.0)[:, None, None],
        dims=("time", "y", "x"),
        coords={"time": start + np.arange(24) * np.timedelta64(10, "s")},
    )
    same, frames, none = average_cycles(fused, field)
    assert same is fused and frames is field and none == []
    monkeypatch.setattr("fusion.pipeline.positioning.MOST_CYCLES", 4)
    means, frames, (notice,) = average_cycles(fused, field)
    # Readings count at their own times: of the first three cycles the second target misses one.
    np.testing.assert_allclose(means["deviation"][0, 0], [2.0, 4.0])
    assert means["time"].values[0, 0, 1] == start + np.timedelta64(40, "s")
    assert np.isnan(means["deviation"].values[1, 0, 0]) and np.isnat(means["time"].values[1, 0, 0])
    assert means["cycle"].values.tolist() == [2, 5, 8, 11] and means["position"].values.tolist() == [0.0, 50.0]
    np.testing.assert_allclose(frames.values.ravel(), [2.5, 8.5, 14.5, 20.5])
    assert frames["time"].values[0] == start + np.timedelta64(25, "s")
    assert "means of 3 successive cycles (4 of 12)" in notice.message
