"""Camera artefacts: planted ones are detected and named; none is detected where none was planted."""

from __future__ import annotations

import numpy as np

from thermography.radiometry.camera_artefacts import DEAD, NOISY, OFFSET, find_bad_pixels, find_repeats

# Repeated frames -----------------------------------------------------------------------------------------------------


def test_repeated_and_frozen_frames_are_told_apart() -> None:
    time = np.datetime64("2026-03-09", "ms") + np.arange(11) * np.timedelta64(1, "s")
    flags = find_repeats(np.isin(np.arange(11), (2, 6, 7, 8, 9)), time)
    assert [(flag.cause, flag.index, flag.time) for flag in flags] == [
        ("repeated_frame", 2, time[2]),
        ("frozen_frames", 6, time[6]),
    ]
    assert flags[0].message == "1 frame repeats the counts of frame 1"
    assert flags[1].message == "4 frames repeat the counts of frame 5: the camera output was frozen"
    assert find_repeats(np.zeros(11, bool), time) == []


# Bad pixels ----------------------------------------------------------------------------------------------------------


def test_planted_bad_pixels_are_found_and_edges_are_not(rng: np.random.Generator) -> None:
    row, column = np.mgrid[:60, :80]
    # A hot block with sharp edges and a disc: what a table with fiducials looks like.
    scene = (
        18000 + 3000.0 * ((row > 20) & (row < 40) & (column > 30)) - 800.0 * ((row - 30) ** 2 + (column - 15) ** 2 < 36)
    )
    stack = scene + rng.normal(0, 8, (32, 60, 80))
    stack[:, 5, 5] = 16000
    stack[:, 50, 70] += 400
    stack[:, 10, 40] += rng.normal(0, 200, 32)
    flags = find_bad_pixels(np.rint(stack).astype(np.uint16))
    assert flags[5, 5] == DEAD | OFFSET
    assert flags[50, 70] == OFFSET
    assert flags[10, 40] & NOISY
    assert np.count_nonzero(flags) == 3


def test_a_good_detector_has_no_bad_pixels(rng: np.random.Generator) -> None:
    stack = (18000 + rng.normal(0, 8, (32, 120, 160))).astype(np.uint16)
    assert not find_bad_pixels(stack).any()
