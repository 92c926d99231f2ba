"""What a model of a record leaves: rhythms, courses and switchings in its innovations, and slow drifts in the hold-out set."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.record import remainder as module
from fusion.record.blocks import Record
from fusion.record.model import RecordFit, fit_record
from fusion.record.remainder import RecordRemainder, examine
from interferometry.drift.gls import drift_system, fit_fixed_effects
from tests.fusion.record_tables import record_of

BLOCKS = 240
BLOCK = np.arange(BLOCKS)


def record_with(*shapes: np.ndarray, channels: int = 2, load: np.ndarray | None = None) -> Record:
    noise = np.random.default_rng(11).standard_normal((BLOCKS, channels))
    displacement = noise + sum(shapes, np.zeros(BLOCKS))[:, None]
    return record_of(displacement, np.zeros((BLOCKS, 1)), drivers=None if load is None else {"speed": load})


def quiet_fit(record: Record) -> RecordFit:
    """A constant in every channel under a drift that is hardly there, so that innovations are what was put in."""
    fits, rows = [], []
    for response in record.displacement.T:
        here = np.flatnonzero(np.isfinite(response))
        system = drift_system(record.seconds[here], np.ones((here.size, 1)), order=1, ratios=np.array([1e-12]))
        fits.append(fit_fixed_effects(system, response[here], np.ones((here.size, 1))))
        rows.append(here)
    return RecordFit(record, np.ones(BLOCKS, bool), (), tuple(fits), tuple(rows), (1,) * len(fits))


def examined(record: Record, *, hold_out_rmse: float = 0.0) -> RecordRemainder:
    errors = np.full(len(record.channels), hold_out_rmse)
    return examine(quiet_fit(record), errors, np.random.default_rng(1))


def test_noise_leaves_nothing():
    left = examined(record_with())
    assert left.shape == "" and left.rms_um == 0.0 and left.p_value > 0.02
    assert set(left.p_values) == {"course in time", "rhythm", "switching"}


def test_a_rhythm_is_told_with_its_period():
    """Every six blocks of five minutes."""
    left = examined(record_with(0.5 * np.cos(2.0 * np.pi * BLOCK / 6.0)), hold_out_rmse=0.1)
    assert left.shape == "a rhythm of about 30 min"
    assert left.p_value < 0.02 and left.rms_um == pytest.approx(0.1)


def test_what_comes_and_goes_within_blocks_is_a_course_in_time():
    noise = np.random.default_rng(2).standard_normal(BLOCKS + 8)
    left = examined(record_with(1.0 * np.convolve(noise, np.ones(9), "valid") / 2.0))
    assert left.shape == "changes that come and go within a few blocks, too quick for the drift"


def test_quick_responses_at_switchings_are_told():
    load = (BLOCK // 24 % 2).astype(float)
    change = np.flatnonzero(np.diff(load)) + 1
    kick = np.zeros(BLOCKS)
    kick[change] = np.random.default_rng(4).choice([-6.0, 6.0], change.size)
    left = examined(record_with(kick, load=load))
    assert left.shape == "quick responses where a driver is switched"
    # Where no driver was logged there is no switching to respond to.
    assert examined(record_with(kick)).p_values["switching"] == 1.0


def test_a_drift_that_nothing_follows_counts_from_three_times_the_noise():
    """Beside the noise of a block, so that the error is the square root of ten times it."""
    record = record_with()
    noise = float(np.sqrt(np.mean(quiet_fit(record).sigma ** 2)))
    below, above = (examined(record, hold_out_rmse=factor * np.sqrt(10.0) * noise) for factor in (0.99, 1.01))
    assert below.shape == ""
    assert above.shape == "a slow drift that neither temperatures nor drivers follow, largest in all channels alike"
    assert above.rms_um == pytest.approx(1.01 * np.sqrt(10.0) * noise)
    np.testing.assert_allclose(above.variance_share, above.rms_um**2 / record.displacement.var(axis=0))
    assert not above.is_tested


@pytest.mark.parametrize("height", [0.8, 2.0, 10.0])
@pytest.mark.parametrize("period", [6.0, 7.2])
def test_a_strong_rhythm_is_no_course_in_time(height, period):
    left = examined(record_with(height * np.cos(2.0 * np.pi * BLOCK / period)))
    assert left.shape == f"a rhythm of about {5.0 * period:.0f} min" and left.is_tested


def test_what_a_rhythm_leaves_is_told_beside_it():
    load = (BLOCK // 24 % 2).astype(float)
    change = np.flatnonzero(np.diff(load)) + 1
    kick = np.zeros(BLOCKS)
    kick[change] = np.random.default_rng(4).choice([-6.0, 6.0], change.size)
    left = examined(record_with(kick + 1.5 * np.cos(2.0 * np.pi * BLOCK / 6.0), load=load))
    assert left.shape == "a rhythm of about 30 min and quick responses where a driver is switched"


@pytest.mark.parametrize(
    ("errors", "words"),
    [
        ((1.0, 0.71, 0.1), "ch1, ch2"),
        ((1.0, 0.69, 0.1), "ch1"),
        ((1.0, 0.9, 0.8), "all channels alike"),
        ((1.0, np.nan, 0.8), "ch1, ch3"),
    ],
)
def test_the_channels_with_the_larger_errors_are_named(errors, words):
    left = examine(quiet_fit(record_with(channels=3)), 5.0 * np.array(errors), np.random.default_rng(1))
    assert left.shape.endswith(f"largest in {words}")
    assert left.rms_um == pytest.approx(5.0 * np.nanmean(errors))


def test_a_single_channel_is_named():
    left = examine(quiet_fit(record_with(channels=1)), np.array([5.0]), np.random.default_rng(1))
    assert left.shape.endswith("largest in ch1")


def test_both_remainders_are_told():
    left = examined(record_with(0.5 * np.cos(2.0 * np.pi * BLOCK / 6.0)), hold_out_rmse=5.0)
    assert left.shape.startswith("a rhythm of about 30 min and a slow drift")


def test_one_wild_block_makes_no_shape():
    wild = np.zeros(BLOCKS)
    wild[100] = 500.0
    assert examined(record_with(wild)).shape == ""


def test_blocks_without_a_value_are_no_shape(rng):
    record = record_with(0.5 * np.cos(2.0 * np.pi * BLOCK / 6.0))
    holed = record.displacement.copy()
    holed[50:60, 0] = np.nan
    assert examined(replace(record, displacement=holed)).shape == "a rhythm of about 30 min"
    model = fit_record(record, [], np.ones(BLOCKS, bool))
    assert examine(model, np.zeros(2), rng).p_values["rhythm"] < 0.02


def test_statistics_of_a_wave_that_is_known():
    """Three turns of amplitude 2 in 24 blocks, in two channels: all power in one line of eleven, twice the mean at its top."""
    blocks = np.arange(24)
    wave = 2.0 * np.cos(2.0 * np.pi * 3.0 * blocks / 24.0)
    switched = np.isin(blocks, [0, 8])
    memory, line, excess = module._statistics(np.column_stack([0.6 * wave, 0.8 * wave]), switched)
    correlation = [wave[k:] @ wave[:-k] / (wave @ wave) for k in range(1, 13)]
    assert memory == pytest.approx(np.sum(np.square(correlation)))
    assert line == pytest.approx(11.0) and module._strongest_line(wave)[0] == 3
    assert excess == pytest.approx(2.0)
    assert module._statistics(wave[:, None], np.zeros(24, bool))[2] == 0.0


def test_a_wave_is_taken_out_at_its_own_frequency_between_the_lines():
    """10.3 turns of amplitude 3 beside a small ramp, which stays."""
    turns = 10.3 / BLOCKS
    ramp = np.linspace(-0.1, 0.1, BLOCKS)
    wave = 3.0 * np.cos(2.0 * np.pi * turns * BLOCK + 0.4)
    frequency, left, share = module._without_wave(np.column_stack([wave + ramp, -wave]))
    assert frequency == pytest.approx(turns, rel=1e-6)
    assert share > 0.999
    assert np.abs(left[:, 1]).max() < 1e-6
    assert np.corrcoef(left[:, 0], ramp)[0, 1] > 0.99
