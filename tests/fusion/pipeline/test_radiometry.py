"""Radiometry of a campaign: stated and assumed uncertainties, regions of another emissivity, and what the results say of both."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.campaign.config import ThermographyTable, load_campaign
from fusion.campaign.inputs import read_source
from fusion.pipeline.radiometry import complete_fields, overridden_parameters, stated_uncertainty
from fusion.products.results import Outcome, assemble
from fusion.products.store import read_dataset
from thermography.errors import ThermographyError
from thermography.radiometry.overrides import Overrides
from thermography.radiometry.planck import counts_from_temperature, temperature_from_counts
from thermography.radiometry.uncertainty import InputUncertainty

ADDED = ("temperature_u", "temperature_rise_u", "rise_scale_u")
REGION = '\n[[thermography.region]]\nname = "steel"\nrectangle = [["80 mm", "20 mm"], ["240 mm", "160 mm"]]\n'


def completed(campaign: Path, results_folder: Path, *changes: tuple[str, str], region: str = "") -> Outcome[xr.Dataset]:
    """The fields of the small campaign, completed once more after changes of its file."""
    text = campaign.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    changed = campaign.with_name("changed.toml")
    changed.write_text(text + region)
    source = read_source(load_campaign(changed))
    fields = read_dataset(results_folder / "fields.nc").drop_vars(ADDED)
    return complete_fields(source, fields, Overrides(overridden_parameters(source.thermography)))


@pytest.fixture
def campaign(copied: Path) -> Path:
    return copied / "campaign.toml"


def test_stated_uncertainties_replace_the_defaults() -> None:
    table = ThermographyTable(
        frames=("a.jpg",),
        emissivity="0.9 +- 0.02",
        reflected_temperature="22 +- 2 degC",
        camera_scale_u="1 %",
        window_transmission=0.9,
    )  # type: ignore[call-arg]
    inputs = stated_uncertainty(table)
    assert (inputs.emissivity, inputs.reflected_temperature_K, inputs.camera_scale) == (0.02, 2.0, 0.01)
    assert inputs.camera_offset_K == InputUncertainty().camera_offset_K
    parameters = overridden_parameters(table)
    assert parameters == {"emissivity": 0.9, "reflected_temperature_K": 295.15, "window_transmission": 0.9}


def test_results_give_both_parts_and_say_what_was_assumed(results_folder: Path) -> None:
    part = json.loads((results_folder / "results.json").read_text())["radiometry"]
    temperature, rise = part["temperature_u"], part["rise_u"]
    # Absolute temperatures carry the camera's accuracy, rises the scale; the noise of a cell is some millikelvin.
    assert temperature["noise_K"] < 0.02 and 1.0 < temperature["common_K"] < 1.5
    assert rise["total_K"] == pytest.approx(np.hypot(rise["noise_K"], rise["common_K"]), rel=1e-6)
    assert part["rise_scale_u"] == pytest.approx(0.0152, abs=0.001)
    sources = {entry["input"]: entry["source"] for entry in part["budget"]}
    assert sources.pop("camera_drift_K") == "measured" and set(sources.values()) == {"assumed"}
    total = np.sqrt(sum(entry["temperature_u_K"] ** 2 for entry in part["budget"]))
    assert total == pytest.approx(temperature["common_K"], rel=0.02)
    html = (results_folder / "report.html").read_text()
    assert "are common to all; rise" in html and "Uncertainty budget of temperature and rise" in html


def test_a_stated_emissivity_is_its_share_of_every_rise(campaign: Path, results_folder: Path) -> None:
    exact = '\nreflected_temperature_u = "0 K"\natmospheric_temperature_u = "0 K"\nrelative_humidity_u = 0.0\nobject_distance_u = "0 m"\n'
    camera = 'camera_offset_u = "0 K"\ncamera_scale_u = 0.0'
    stated = ("emissivity = 0.97", f'emissivity = "0.97 +- 0.0097"{exact}{camera}')
    outcome = completed(campaign, results_folder, stated)
    assert outcome.parts["radiometry"]["rise_scale_u"] == pytest.approx(0.01, rel=0.05)
    assert {entry["input"]: entry["source"] for entry in outcome.parts["radiometry"]["budget"]}[
        "emissivity"
    ] == "stated"
    rise, u = (outcome.dataset[name].isel(cycle=-1) for name in ("temperature_rise", "temperature_rise_u"))
    common = np.sqrt(u**2 - outcome.dataset["temperature_rise_noise_u"].isel(cycle=-1) ** 2)
    zero = float(outcome.dataset["camera_correction_u"][-1])
    warm = (rise > 1.0).values
    np.testing.assert_allclose(common.values[warm], np.hypot(0.01 * rise, zero).values[warm], rtol=0.08)


@pytest.mark.parametrize(("stated_K", "taken"), [(2.0, "stated"), (0.001, "measured")])
def test_the_larger_of_stated_and_measured_drift_is_taken_and_said(
    campaign: Path, results_folder: Path, stated_K: float, taken: str
) -> None:
    outcome = completed(
        campaign, results_folder, ("emissivity = 0.97", f'emissivity = 0.97\ncamera_drift_u = "{stated_K} K"')
    )
    entry = next(item for item in outcome.parts["radiometry"]["budget"] if item["input"] == "camera_drift_K")
    left_K = float(outcome.dataset["camera_correction_u"].max())
    assert entry["source"] == taken and entry["u"] == pytest.approx(max(stated_K, left_K))
    u = float(outcome.dataset["temperature_rise_u"].isel(cycle=-1).mean())
    assert (u > stated_K) if taken == "stated" else (u < 1.0)
    notice = next(item for item in outcome.notices if item.code == "camera_drift_stated")
    assert "The larger was taken" in notice.message


def test_a_region_is_calibrated_with_its_own_emissivity(campaign: Path, results_folder: Path) -> None:
    outcome = completed(campaign, results_folder, region=REGION + 'emissivity = "0.5 +- 0.02"\n')
    before, after = read_dataset(results_folder / "fields.nc"), outcome.dataset
    inside = {"x": slice(120, 200), "y": slice(60, 120)}
    source = read_source(load_campaign(campaign))
    camera = Overrides(overridden_parameters(source.thermography))(source.frames[0])
    for name in ("temperature", "frame_temperature"):
        counts = counts_from_temperature(before[name].sel(inside).values, camera)
        expected = temperature_from_counts(counts, camera, emissivity=0.5)
        np.testing.assert_allclose(after[name].sel(inside).values, expected, atol=1e-3)
    steel, rest = (after["rise_scale_u"].sel(x=x, y=90, method="nearest") for x in (160, 400))
    assert steel > 2 * rest
    (notice,) = outcome.notices
    assert notice.message.endswith("cells at the edges of region steel see two surfaces and were left empty.")
    part = outcome.parts["radiometry"]
    assert [surface["name"] for surface in part["surfaces"]] == ["", "steel"]
    assert part["edge_cells"] == int(notice.message.split()[0]) > 0
    assert assemble("x", outcome.parts, outcome.notices).radiometry is not None


def test_the_emissivity_of_a_region_comes_from_two_states(campaign: Path, results_folder: Path) -> None:
    """The table of the twin is painted: what the camera reads in two cycles, taken as contact temperatures, gives 0.97 again."""
    fields = read_dataset(results_folder / "fields.nc").sel(x=slice(100, 220), y=slice(40, 140))["temperature"]
    first, last = (float(fields.sel(cycle=cycle).mean()) for cycle in (1, 24))
    known = [
        f'{{cycle = {cycle}, temperature = "{celsius:.4f} +- 0.01 degC"}}'
        for cycle, celsius in ((1, first), (24, last))
    ]
    states = f"states = [{', '.join(known)}]\n"
    outcome = completed(campaign, results_folder, region=REGION + states)
    steel = outcome.parts["radiometry"]["surfaces"][1]
    assert steel["source"] == "two states"
    assert steel["emissivity"]["value"] == pytest.approx(0.97, abs=3 * steel["emissivity"]["u"])
    assert steel["emissivity"]["u"] < 0.1


def test_an_emissivity_that_may_be_nothing_is_refused(campaign: Path, results_folder: Path) -> None:
    with pytest.raises(
        ThermographyError, match=r"emissivity 0\.1 with a standard uncertainty of 0\.06: .*paint the surface"
    ):
        completed(campaign, results_folder, region=REGION + 'emissivity = "0.1 +- 0.06"\n')
