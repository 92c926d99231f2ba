"""Steps and drift of the camera's zero on campaigns of the twin, against its truth: docs/method/radiometry.md, "The camera itself"."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import load_campaign
from fusion.campaign.inputs import read_source
from fusion.pipeline.thermal import camera_corrected, reduce_thermography
from fusion.results.progress import silent
from fusion.twin import simulate
from fusion.twin.instruments import write_campaign
from fusion.twin.recipe import Recipe

pytestmark = pytest.mark.slow

SMALL = {"columns": 320, "rows": 240, "focal_px": 765.0, "file": "seq"}
SEEDS = (11, 12, 13)


@pytest.mark.parametrize(
    ("ffc_step_K", "drift_K_per_K"), [(0.0, 0.0), (0.1, 0.0), (0.3, 0.1), (0.5, 0.0), (0.5, 0.3), (0.0, 0.3)]
)
def test_rise_with_steps_and_drift(tmp_path: Path, ffc_step_K: float, drift_K_per_K: float) -> None:
    ratios, errors = [], []
    for seed in SEEDS:
        camera = {**SMALL, "ffc_step_K": ffc_step_K, "drift_K_per_K": drift_K_per_K}
        truth = simulate(Recipe().vary(campaign={"seed": seed}, camera=camera))
        campaign = write_campaign(truth, tmp_path / f"{seed}")
        source = read_source(load_campaign(campaign))
        outcome = reduce_thermography(source, checkpoint=tmp_path / f"cycles{seed}", scheduler=None, report=silent)
        fields, part = outcome.dataset, outcome.parts.camera
        true = truth.temperature(truth.session.frame_s, fields["x"].values, fields["y"].values, cell_mm=5.0)
        error = (fields["temperature_rise"].values - (true - true[0]))[1:]
        u = np.hypot(
            fields["temperature_rise_noise_u"].values[1:], fields["camera_correction_u"].values[1:, None, None]
        )
        errors.append(np.sqrt(np.nanmean(error**2)))
        ratios.append(np.sqrt(np.nanmean((error / u) ** 2)))
        assert camera_corrected(part) == (ffc_step_K > 0 or drift_K_per_K > 0)
    with_digits = ", ".join(f"{ratio:.2f}" for ratio in ratios)
    print(
        f"\nFFC {ffc_step_K} K, drift {drift_K_per_K} K/K: error of the rise {1e3 * np.mean(errors):.0f} mK, over u: {with_digits}"
    )
    assert max(ratios) < 2.0
