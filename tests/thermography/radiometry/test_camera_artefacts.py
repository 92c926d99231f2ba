"""Camera artefacts: planted ones are detected, corrected and named; none is detected where none was planted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.thermography.flir_mutations import PARAMETERS, frame
from thermography.io.flir import FrameReference, index_frames
from thermography.io.flir_writer import write_sequence
from thermography.radiometry.camera_artefacts import (
    DEAD,
    NOISY,
    OFFSET,
    Levels,
    anchor,
    find_bad_pixels,
    find_repeats,
    find_steps,
    read_levels,
    regress_drift,
)
from thermography.radiometry.planck import RadiometryError, counts_from_temperature

ROWS, COLUMNS = 48, 64
NOISE_K = 0.05


def _record(
    path: Path, frames: int, rng: np.random.Generator, *, steps: dict[int, float], interval_s: float = 5.0
) -> tuple[list[FrameReference], np.ndarray]:
    """Write a scene that warms by 3 K in one corner under a camera that drifts and steps; return frames and offsets."""
    row, column = np.mgrid[:ROWS, :COLUMNS]
    spot = np.exp(-((row - 40) ** 2 + (column - 55) ** 2) / 200)
    seconds = interval_s * np.arange(frames)
    offset = 0.2 * np.sin(2 * np.pi * seconds / 3600)
    for index, size in steps.items():
        offset[index:] += size

    def frames_of_scene():
        for second, shift in zip(seconds, offset, strict=True):
            warm = 22 + 0.02 * column + 3 * (1 - np.exp(-second / 900)) * spot
            temperature = warm + shift + rng.normal(0, NOISE_K, warm.shape)
            counts = np.rint(counts_from_temperature(temperature, PARAMETERS)).astype(np.uint16)
            yield replace(frame(1, 1), counts=counts, time=frame(1, 1).time + np.timedelta64(int(second * 1000), "ms"))

    write_sequence(path, frames_of_scene())
    references, rejected = index_frames([path])
    assert rejected == []
    return references, offset


def _levels(change: np.ndarray, *, share: float = 1.0, seconds: float = 5.0) -> Levels:
    time = np.datetime64("2026-03-09") + (1000 * seconds * np.arange(len(change))).astype("timedelta64[ms]")
    return Levels(time, change, np.full(len(change), share), np.zeros(len(change), bool))


# Flat-field steps ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0.3, -0.3, 0.15])
def test_planted_steps_are_found_where_they_are_and_re_anchored(
    tmp_path: Path, rng: np.random.Generator, size: float
) -> None:
    planted = {60: size, 140: -size / 2 if abs(size) == 0.3 else size}
    frames, offset = _record(tmp_path / "a.seq", 200, rng, steps=planted)
    levels = read_levels(frames)
    steps = find_steps(levels)
    assert [step.index for step in steps] == list(planted)
    assert {step.cause for step in steps} == {"flat_field_step"}
    assert "(flat-field correction)" in steps[0].message
    for step in steps:
        assert step.value_K == pytest.approx(planted[step.index], abs=0.03)
        assert 0 < step.value_u_K < 0.02
    smooth = offset - sum(np.where(np.arange(200) >= index, height, 0) for index, height in planted.items())
    remaining = offset + anchor(levels, steps) - smooth
    assert np.abs(remaining).max() < 0.030


def test_a_reference_region_serves_when_the_scene_warms_everywhere(tmp_path: Path, rng: np.random.Generator) -> None:
    frames, _ = _record(tmp_path / "a.seq", 120, rng, steps={50: 0.3})
    patch = np.zeros((ROWS, COLUMNS), bool)
    patch[:10, :10] = True
    levels = read_levels(frames, lambda each: each.parameters, reference=patch)
    (step,) = find_steps(levels)
    assert step.index == 50 and step.value_K == pytest.approx(0.3, abs=0.03)


def test_no_step_is_reported_where_none_is(tmp_path: Path, rng: np.random.Generator) -> None:
    frames, _ = _record(tmp_path / "a.seq", 1000, rng, steps={})
    assert find_steps(read_levels(frames)) == []


def test_uneven_intervals_are_no_steps() -> None:
    """A scene that warms by 2 K per hour, with pauses of up to ten minutes between frames 5 s apart."""
    rng = np.random.default_rng(5)
    seconds = np.cumsum(np.where(rng.random(300) < 0.05, 600.0, 5.0))
    change = np.concatenate(([0.0], np.diff(2 * seconds / 3600))) + rng.normal(0, 0.001, 300)
    time = np.datetime64("2026-03-09") + (1000 * seconds).astype("timedelta64[ms]")
    assert find_steps(Levels(time, change, np.ones(300), np.zeros(300, bool))) == []


def test_what_comes_back_or_moves_a_part_is_named_and_not_corrected() -> None:
    rng = np.random.default_rng(6)
    change = rng.normal(0, 0.002, 100)
    passing = change.copy()
    passing[40] += 0.5
    passing[41] -= 0.5
    flags = find_steps(_levels(passing))
    assert {flag.cause for flag in flags} == {"transient"}
    assert "and returned: not attributed to a flat-field correction" in flags[0].message
    moved = change.copy()
    moved[40] += 0.5
    (flag,) = find_steps(_levels(moved, share=0.6))
    assert flag.cause == "transient" and "in only 60% of the reference" in flag.message
    np.testing.assert_array_equal(anchor(_levels(moved), [flag]), 0)


def test_a_handful_of_frames_cannot_show_a_step() -> None:
    assert find_steps(_levels(np.array([0.0, 0.5, 0.0, 0.0]))) == []


def test_a_reference_of_another_shape_is_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    frames, _ = _record(tmp_path / "a.seq", 2, rng, steps={})
    with pytest.raises(
        RadiometryError, match=r"reference: expected pixels in a mask of shape \(48, 64\), got 4 in \(2, 2\)"
    ):
        read_levels(frames, reference=np.ones((2, 2), bool))
    with pytest.raises(RadiometryError, match=r"got 0 in \(48, 64\)"):
        read_levels(frames, reference=np.zeros((ROWS, COLUMNS), bool))


# Repeated frames -----------------------------------------------------------------------------------------------------


def test_repeated_and_frozen_frames_are_told_apart(tmp_path: Path) -> None:
    seeds = [0, 1, 1, 2, 3, 4, 4, 4, 4, 4, 5]
    template = frame(1, 1)
    write_sequence(
        tmp_path / "a.seq",
        [
            replace(frame(ROWS, COLUMNS, seed=seed), time=template.time + np.timedelta64(second, "s"))
            for second, seed in enumerate(seeds)
        ],
    )
    levels = read_levels(index_frames([tmp_path / "a.seq"])[0])
    flags = find_repeats(levels)
    assert [(flag.cause, flag.index) for flag in flags] == [("repeated_frame", 2), ("frozen_frames", 6)]
    assert flags[0].message == "1 frame repeats the counts of frame 1"
    assert flags[1].message == "4 frames repeat the counts of frame 5: the camera output was frozen"


# Slow drift ----------------------------------------------------------------------------------------------------------


def _of(level: np.ndarray) -> Levels:
    return _levels(np.diff(level, prepend=0.0))


def _temperatures(frames: int, rng: np.random.Generator) -> np.ndarray:
    """Three camera temperatures (K) of a body that warms and of a room that breathes; the last one is constant."""
    t = np.linspace(0, 8, frames)
    body = 300 + 6 * (1 - np.exp(-t / 1.5))
    lens = 299 + 5 * (1 - np.exp(-t / 2.5)) + 0.3 * np.sin(2 * np.pi * t / 3)
    read = np.column_stack((body, lens)) + rng.normal(0, 0.02, (frames, 2))
    return np.column_stack((read, np.full(frames, 290.0)))


def test_drift_with_the_camera_is_explained_and_removed(rng: np.random.Generator) -> None:
    temperature = _temperatures(400, rng)
    planted = 0.08 * (temperature[:, 0] - 300) - 0.05 * (temperature[:, 1] - 299)
    level = planted - planted[0] + rng.normal(0, 0.005, 400)
    drift = regress_drift(_of(level), [], temperature, ["TSCapsule", "TSLens", "TSShutter"])
    assert drift.p_value < 1e-6 and drift.explained > 0.9
    assert drift.coefficients["TSCapsule"] == pytest.approx(0.08, abs=0.01)
    assert drift.coefficients["TSLens"] == pytest.approx(-0.05, abs=0.015)
    assert "TSShutter" not in drift.coefficients
    assert drift.flag is not None and drift.flag.cause == "camera_drift"
    assert drift.flag.value_K == pytest.approx(np.ptp(planted), rel=0.05)
    assert "of a drift; up to 0." in drift.flag.message
    assert np.std(level + drift.correction) < 0.007 < np.std(level)


def test_noise_is_not_explained_by_the_camera() -> None:
    corrected = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        drift = regress_drift(_of(rng.normal(0, 0.01, 300)), [], _temperatures(300, rng), ["a", "b", "c"])
        corrected += bool(drift.correction.any())
    # One in a hundred by chance at a significance of 0.01; 5 or more has a probability of 0.4 %.
    assert corrected < 5


def test_a_wandering_level_is_not_easily_explained() -> None:
    """Two series that wander correlate without a cause; the effective number of frames must account for it."""
    corrected = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        wander = np.cumsum(rng.normal(0, 1, (300, 2)), axis=0)
        drift = regress_drift(_of(wander[:, 0] * 0.01), [], 300 + wander[:, 1:], ["TSLens"])
        corrected += bool(drift.correction.any())
    assert corrected <= 10


@pytest.mark.parametrize("temperature", [np.full((50, 1), 300.0), np.full((50, 1), np.nan)])
def test_sensors_without_change_or_with_gaps_explain_nothing(temperature: np.ndarray) -> None:
    drift = regress_drift(_of(np.linspace(0, 1, 50)), [], temperature, ["TSLens"])
    assert not drift.correction.any() and drift.coefficients == {} and drift.p_value == 1.0 and drift.flag is None


def test_steps_are_no_drift(rng: np.random.Generator) -> None:
    """A step that happens while the camera warms must not pass for its drift."""
    temperature = _temperatures(300, rng)
    level = rng.normal(0, 0.003, 300) + np.where(np.arange(300) >= 150, 0.4, 0.0)
    levels = _of(level)
    steps = find_steps(levels)
    assert [step.index for step in steps] == [150]
    drift = regress_drift(levels, steps, temperature, ["a", "b", "c"])
    # The step is known to about 3 mK, and only that rest may look like drift.
    assert np.ptp(drift.correction) < 0.01


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
