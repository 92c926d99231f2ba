"""The truth as Datasets without files keeps the instruments' contracts, with the camera's noise and errors."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.twin.machine.recipe import EffectRecipe, Recipe
from fusion.twin.simulate import simulate
from fusion.twin.truth import deviations_of, fields_of
from interferometry.contract import DEVIATIONS
from thermography.contract import FIELDS


def test_datasets_without_files_keep_the_contracts():
    truth = simulate(Recipe().vary(test={"cycles": 5, "missing_fraction": 0.1}))
    for dataset, contract in ((deviations_of(truth), DEVIATIONS), (fields_of(truth), FIELDS)):
        for name, (dims, units, kind) in contract.items():
            assert dataset[name].dims == dims, name
            assert dataset[name].dtype.kind == kind, name
            assert dataset[name].attrs.get("units", "") == units, name
    deviations = deviations_of(truth)
    assert np.array_equal(np.isnat(deviations["time"].values), np.isnan(deviations["deviation"].values))


def test_fields_without_files_are_cell_means_with_the_frames_noise():
    truth = simulate(Recipe().vary(test={"cycles": 6}))
    quiet, noisy = fields_of(truth, noise_K=0.0), fields_of(truth)
    fine_x, fine_y = np.arange(0.25, 700, 0.5)[600:610], np.arange(0.25, 180, 0.5)[150:160]
    cell = truth.temperature(truth.session.frame_s, fine_x, fine_y).mean(axis=(1, 2))
    np.testing.assert_allclose(quiet["temperature"].sel(x=302.5, y=77.5), cell, atol=1e-4)
    noise = (noisy["temperature"] - quiet["temperature"]).std()
    # 50 mK over 18.9 pixels of 5 mm
    assert float(noise) == pytest.approx(0.0115, abs=0.0005)


def test_burst_lowers_the_noise_of_a_cycle_and_shows_its_spread():
    single, burst = (simulate(Recipe().vary(test={"cycles": 4}, camera={"frames_per_cycle": n})) for n in (1, 16))
    quiet = fields_of(burst, noise_K=0.0)["temperature"]
    noise = [float((fields_of(truth)["temperature"] - quiet).std()) for truth in (single, burst)]
    # 22,680 values of noise; within three seconds the table itself moves by well under 1 mK
    assert noise[0] / noise[1] == pytest.approx(4.0, rel=0.05)
    assert float(fields_of(burst)["temperature_spread"].mean()) == pytest.approx(0.0115 * np.sqrt(15 / 16), rel=0.05)


def test_fields_without_files_show_what_the_camera_adds():
    effects = (EffectRecipe("camera_offset", amplitude_K=0.5, parameters={"at_cycle": 3}),)
    spot = (EffectRecipe("reflected_source", amplitude_K=40.0, parameters={"follows": "constant"}),)
    plain = fields_of(simulate(Recipe().vary(test={"cycles": 6})), noise_K=0.0)["temperature"]
    lifted = fields_of(simulate(Recipe().vary(test={"cycles": 6}, effect=effects)), noise_K=0.0)["temperature"] - plain
    np.testing.assert_allclose(lifted.mean(["y", "x"]), [0, 0, 0.5, 0.5, 0.5, 0.5], atol=1e-12)
    mirrored = fields_of(simulate(Recipe().vary(test={"cycles": 6}, effect=spot)), noise_K=0.0)["temperature"] - plain
    peak = mirrored[-1].argmax(["y", "x"])
    # the spot's centre lies on the border of two cells in x and of two in y
    assert abs(float(mirrored["x"][peak["x"]]) - 480.0) == 2.5
    assert abs(float(mirrored["y"][peak["y"]]) - 60.0) == 2.5
    # 3 % of 40 K over 97 %, warmed up to 99 %
    assert float(mirrored[-1].max()) == pytest.approx(1.23, abs=0.05)


def test_fields_of_a_moving_table_need_frames():
    with pytest.raises(ValueError, match=r"fields_of needs camera\.table = 'still'; write the campaign"):
        fields_of(simulate(Recipe().vary(test={"cycles": 2}, camera={"table": "moving"})))
