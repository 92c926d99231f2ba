"""Artefacts of the camera, and the correction of its zero within the stated uncertainty."""

from dataclasses import replace

import numpy as np
import pytest

from thermography.radiometry.camera import (
    DEAD,
    NOISY,
    OFFSET,
    Detector,
    LevelSeries,
    _diagonal_of_inverse,
    _find_steps,
    _fit,
    estimate_correction,
    examine_detector,
    find_bad_pixels,
    find_repeats,
    hold_constant,
    room_temperatures,
)

FRAMES, INTERVAL_S = 60, 252.0


def _sound(seed: int, *, logged: bool = True, frames: int = FRAMES, interval_s: float = INTERVAL_S) -> LevelSeries:
    """A room that swings by 0.15 K and wanders, a table that warms by 3 K, and a camera that warms by 6 K with the room."""
    rng = np.random.default_rng([seed, 17])
    minute = np.arange(0.0, frames * interval_s + 60, 60.0)
    walk = 0.05 * np.cumsum(rng.normal(0, np.sqrt(1 / 60), minute.size))
    air = 23.5 + 0.15 * np.sin(2 * np.pi * (minute / 2820 + rng.random())) + walk
    seconds = interval_s * np.arange(frames)
    at_frames = np.interp(seconds, minute, air)
    return LevelSeries(
        seconds=seconds,
        background=0.93 * at_frames + rng.normal(0, 5e-4, frames),
        table=23 + 3 * (1 - np.exp(-seconds / 5000)) + rng.normal(0, 5e-4, frames),
        housing=(at_frames + 273 + 6 * (1 - np.exp(-seconds / 1500)))[:, None] + [0.0, -0.8],
        room=room_temperatures(seconds, minute, np.round(air + rng.normal(0, 0.004, minute.size), 2))
        if logged
        else np.zeros((frames, 0)),
        logged_s=7200.0,
    )


def _with_camera(series: LevelSeries, offset: np.ndarray) -> LevelSeries:
    return replace(series, background=series.background + offset, table=series.table + offset)


def _steps(seed: int, sigma_K: float) -> np.ndarray:
    """A new zero every 15 minutes."""
    number = (INTERVAL_S * np.arange(FRAMES) // 900).astype(int)
    return sigma_K * np.random.default_rng([seed, 3]).normal(size=number.max() + 1)[number]


def _drift(series: LevelSeries, per_K: float) -> np.ndarray:
    return per_K * (series.housing[:, 0] - series.housing[0, 0])


@pytest.mark.parametrize(("sigma_K", "per_K"), [(0.1, 0.0), (0.3, 0.1), (0.5, 0.3), (0.0, 0.1)])
def test_steps_and_drift_are_taken_out_within_their_uncertainty(sigma_K, per_K):
    ratios = []
    for seed in range(6):
        series = _sound(seed)
        offset = _steps(seed, sigma_K) + _drift(series, per_K)
        found = estimate_correction(_with_camera(series, offset))
        error = offset - offset[0] + found.correction_K
        assert np.sqrt(np.mean(error**2)) < 0.08 < np.ptp(offset)
        assert bool(found.drift_K.any()) == (per_K > 0)
        ratios.append(np.mean((error[1:] / found.u_K[1:]) ** 2))
    # The mean over 6 campaigns, each with a few independent errors: a factor of 1.5 either way of 1, smaller where all parts are known.
    assert np.sqrt(np.mean(ratios)) < 1.5


def test_a_sound_camera_is_left_alone():
    corrected = sum(estimate_correction(_sound(seed, logged=seed % 2 == 0)).corrects for seed in range(60))
    # At two tests of one per mille each, more than one of 60 has a probability of 0.6 %.
    assert corrected <= 1


def test_a_housing_that_is_cleaner_than_the_log_does_not_stand_in_for_the_room():
    """Surroundings that are 0.93 of the air, a housing that warms by 0.5 K and is logged without noise or nearly so, a log with noise."""
    seconds, minute = 125.0 * np.arange(28), np.arange(0.0, 3600.0, 60.0)
    corrected = 0
    for seed in range(48):
        rng = np.random.default_rng([seed, 31])
        phase = rng.uniform(0, 2 * np.pi)
        air, logged = (23.4 + 0.25 * np.sin(2 * np.pi * at / 5200 + phase) for at in (seconds, minute))
        housing = 300 + 0.5 * (1 - np.exp(-seconds[:, None] / 2400)) + rng.normal(0, 0.003 * (seed % 2), (28, 1))
        logged += rng.normal(0, (0.01, 0.03)[seed // 2 % 2], minute.size)
        room = room_temperatures(seconds, minute, logged)
        table = 23 + 3 * (1 - np.exp(-seconds / 5000))
        corrected += estimate_correction(LevelSeries(seconds, 0.93 * air, table, housing, room)).corrects
    assert corrected == 0


def test_a_step_has_its_place_size_and_uncertainty_and_one_beside_the_table_is_the_rooms():
    offset = np.where(np.arange(FRAMES) >= 20, 0.25, 0.0)
    (step,) = estimate_correction(_with_camera(_sound(1), offset)).steps
    assert step.index == 20
    assert step.value_K == pytest.approx(0.25, abs=3 * step.u_K)
    assert 0.001 < step.u_K < 0.03
    # A door opens: what lies beside the table changes, the table does not.
    series = _sound(2)
    beside = series.background + np.where(np.arange(FRAMES) >= 30, 0.4, 0.0)
    found = estimate_correction(replace(series, background=beside))
    assert found.steps == () and not found.corrects


def test_without_a_log_of_the_room_or_with_another_nothing_is_corrected():
    series = _sound(3, logged=False)
    offset = _drift(series, 0.1)
    found = estimate_correction(_with_camera(series, offset))
    assert not found.corrects
    assert found.u_K[-1] > 0.5 * abs(offset[-1])
    assert np.abs(found.unexplained_K).max() > 0.5
    # The camera is warm and follows the room, as the background does; the log does not: the room must not pass for a drift.
    series = replace(_sound(4), room=_sound(5).room)
    noise = np.random.default_rng(4).normal(0, 0.01, (FRAMES, 1))
    follows = replace(series, housing=series.background[:, None] + 280.0 + noise)
    assert not estimate_correction(follows).drift_K.any()


def test_steps_in_a_film_are_placed_to_the_frame():
    """3000 frames at 5 s: more than the fit takes."""
    series = _sound(6, frames=3000, interval_s=5.0)
    offset = np.where(np.arange(3000) >= 1234, -0.3, 0.0)
    (step,) = estimate_correction(_with_camera(series, offset)).steps
    assert step.index == 1234 and step.value_K == pytest.approx(-0.3, abs=0.03)


def test_steps_leave_enough_changes_to_tell_a_log_that_ends_early(rng):
    """The room is logged for five changes, in which the camera behaves unlike later: without them nothing is known of the room."""
    room = [
        [0.115, -0.020, -0.012],
        [0.161, -0.099, -0.003],
        [-0.028, -0.089, 0.013],
        [-0.146, 0.008, 0.001],
        [-0.079, 0.044, -0.008],
    ]
    change, regressors = 0.002 * rng.standard_normal(51), np.zeros((51, 4))
    regressors[:5, :3], regressors[:, 3] = room, 0.25 * np.sin(0.76 * np.arange(51))
    regressors[:5, 3] = 2.0, 1.3, 1.1, 1.0, 0.7
    change += 0.68 * regressors[:, 3]
    change[:5], change[28] = [-0.17, -0.28, 0.05, 0.23, 0.21], 8.7
    places, fit = _find_steps(change, regressors, np.full(51, 300.0))
    assert 28 in places
    assert np.linalg.matrix_rank(np.delete(regressors, places, axis=0)) == 4
    assert (np.diag(fit.covariance) > 0).all()


@pytest.mark.parametrize("frames", [2, 7])
def test_few_frames_correct_nothing(frames):
    series = _sound(7, frames=frames)
    found = estimate_correction(series)
    assert not found.corrects and found.steps == ()
    np.testing.assert_allclose(found.u_K, np.abs(series.background - series.background[0]) / np.sqrt(3))


def test_a_change_with_a_step_of_its_own_tells_nothing_of_the_others(rng):
    seconds, regressors, places = rng.choice([5.0, 120.0], 60), rng.normal(size=(60, 2)), [7, 8, 40]
    change = regressors @ [0.3, -0.2] + 0.02 * rng.normal(size=60) * np.sqrt(seconds / 60.0)
    moved = change.copy()
    moved[places] += [5.0, -3.0, 0.7]
    fit, other = (_fit(each, regressors, places, seconds) for each in (change, moved))
    np.testing.assert_allclose(other.values - fit.values, [0, 0, 5.0, -3.0, 0.7], atol=1e-9)
    np.testing.assert_allclose(other.covariance, fit.covariance, rtol=1e-9)
    np.testing.assert_allclose(np.delete(other.shocks, places), np.delete(fit.shocks, places), atol=1e-9)


def test_the_diagonal_of_an_inverse_is_that_of_the_dense_matrix(rng):
    lower = np.stack([rng.uniform(1.0, 2.0, 40), rng.uniform(-0.9, 0.9, 40)])
    factor = np.diag(lower[0]) + np.diag(lower[1, :-1], -1)
    np.testing.assert_allclose(_diagonal_of_inverse(lower), np.diag(np.linalg.inv(factor @ factor.T)), rtol=1e-10)


def test_a_frozen_camera_and_missing_sensors_are_no_faults():
    series = _sound(8)
    frozen = replace(
        series, background=np.full(FRAMES, 23.0), table=np.full(FRAMES, 24.0), housing=np.full((FRAMES, 1), np.nan)
    )
    assert not estimate_correction(frozen).corrects


def test_walls_follow_the_air_by_their_lags():
    logged = np.arange(0.0, 7200.0, 60.0)
    air = np.where(logged < 1800, 20.0, 21.0)
    room = room_temperatures(np.array([0.0, 1800.0 + 600.0]), logged, air)
    np.testing.assert_allclose(room[0], 20.0)
    np.testing.assert_allclose(room[1], [21.0, 21 - np.exp(-1), 21 - np.exp(-1 / 6)], atol=1e-9)
    assert room_temperatures(np.zeros(3), logged[:1], air[:1]).shape == (3, 0)


def test_a_surface_of_constant_temperature_is_held_constant():
    rng = np.random.default_rng(9)
    offset = _steps(9, 0.3) + 0.002 * np.arange(FRAMES)
    found = hold_constant(24.0 + offset + rng.normal(0, 0.004, FRAMES))
    error = offset - offset[0] + found.correction_K
    assert np.sqrt(np.mean(error[1:] ** 2)) < 0.01
    # The first frame's scatter is common to all: about one draw of it, and steps raise the median difference a little.
    assert np.sqrt(np.mean((error[1:] / found.u_K[1:]) ** 2)) < 2.0
    assert found.u_K[0] == 0.0 and np.ptp(found.drift_K) == pytest.approx(np.ptp(offset), abs=0.03)


def test_the_scatter_of_a_constant_surface_is_not_corrected():
    rng = np.random.default_rng(10)
    # At one per mille, 4 or more of 300 have a probability of 0.03 %.
    assert sum(hold_constant(rng.normal(24.0, 0.004, FRAMES)).corrects for _ in range(300)) < 4
    assert not hold_constant(np.full(FRAMES, 24.0)).corrects and not hold_constant(np.arange(3.0)).corrects


# Repeated frames -----------------------------------------------------------------------------------------------------


def test_repeated_and_frozen_frames_are_told_apart():
    assert find_repeats(np.isin(np.arange(11), (2, 6, 7, 8, 9))) == [
        (2, "1 frame repeats the counts of frame 1"),
        (6, "4 frames repeat the counts of frame 5: the camera output was frozen"),
    ]
    assert find_repeats(np.zeros(11, bool)) == []


# Bad pixels ----------------------------------------------------------------------------------------------------------


def test_planted_bad_pixels_are_found_and_edges_are_not(rng):
    row, column = np.mgrid[:60, :80]
    # A hot block with sharp edges and a disc: what a table with fiducials looks like.
    block, disc = (row > 20) & (row < 40) & (column > 30), (row - 30) ** 2 + (column - 15) ** 2 < 36
    scene = 18000 + 3000.0 * block - 800.0 * disc
    stack = scene + rng.normal(0, 8, (32, 60, 80))
    stack[:, 5, 5] = 16000
    stack[:, 50, 70] += 400
    stack[:, 10, 40] += rng.normal(0, 200, 32)
    flags = find_bad_pixels(np.rint(stack).astype(np.uint16))
    assert flags[5, 5] == DEAD | OFFSET
    assert flags[50, 70] == OFFSET
    assert flags[10, 40] & NOISY
    assert np.count_nonzero(flags) == 3


def test_a_good_detector_has_no_bad_pixels(rng):
    stack = (18000 + rng.normal(0, 8, (32, 120, 160))).astype(np.uint16)
    assert not find_bad_pixels(stack).any()


def test_a_pixel_that_blinks_for_a_part_of_the_test_is_found_while_the_scene_moves(rng):
    column = np.arange(80)
    stack = np.stack([16000 + 400 * np.sin((column + 2 * k) / 9.0) + rng.normal(0, 8, (60, 80)) for k in range(48)])
    stack[10:14, 30, 40] += 340
    stack[:, 20, 60] = 16300
    flags = find_bad_pixels(np.rint(stack).astype(np.uint16))
    assert flags[30, 40] & NOISY and flags[20, 60] & DEAD
    assert np.count_nonzero(flags) == 2


def test_clipped_counts_are_found_and_coarse_or_sound_pictures_are_not_accused(rng):
    row, column = np.mgrid[:60, :80]
    hill = 16000 + 900 * np.exp(-((row - 30) ** 2 + (column - 40) ** 2) / 200)
    stack = np.rint(hill + np.arange(24)[:, None, None] * 5 + rng.normal(0, 8, (24, 60, 80))).astype(np.uint16)
    sound = examine_detector(stack)
    assert not sound.clips and not sound.bad.any()
    # A pixel that is stuck at the end of the counts does not hide the others.
    stuck = np.minimum(stack, 16700)
    stuck[:, 5, 5] = 65535
    high, low = examine_detector(stuck), examine_detector(np.maximum(stack, 16040))
    assert (high.lowest, high.highest) == (-1, 16700) and high.bad[5, 5]
    assert (low.lowest, low.highest) == (16040, 65536)
    # Steps of 40 counts, five times the noise: whole plains share a count, also the highest one.
    coarse = examine_detector((stack // 40 * 40).astype(np.uint16))
    assert not coarse.clips and not coarse.bad.any()
    assert examine_detector(np.full((8, 60, 80), 65535, np.uint16)).highest == 65535


def test_bad_pixels_get_the_mean_of_their_sound_neighbours():
    counts = np.tile(np.arange(100, 105, dtype=np.uint16), (2, 5, 1))
    flags = np.zeros((5, 5), np.uint8)
    flags[2, 2] = flags[2, 3] = DEAD
    counts[:, 2, 2:4] = 60000
    Detector(flags).repair(counts)
    np.testing.assert_array_equal(counts[:, 2], [[100, 101, 102, 103, 104]] * 2)
