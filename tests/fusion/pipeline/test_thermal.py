"""What the thermal stage tells of the camera before it reduces a frame."""

import numpy as np

from fusion.pipeline.thermal import pixel_notices


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
    assert notice.message.endswith("1 noisy); they count in their cells like others.")
