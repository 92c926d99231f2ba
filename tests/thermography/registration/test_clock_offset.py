"""One clock: offsets put in are found again with an uncertainty that covers, and what cannot be known is refused."""

from functools import partial

import numpy as np
import pytest

from tests.thermography.table_motion import FEED_MM_S, T0, campaign, positioning_test
from thermography.registration.clock_offset import ClockError, commanded_position
from thermography.registration.clock_offset import estimate_clock_offset as estimate_between_clocks

#: The readings of these motions are taken just before the table goes on.
estimate_clock_offset = partial(estimate_between_clocks, reading_phase=1.0)
pytestmark = pytest.mark.long


def test_offset_of_37_s_is_found_and_its_uncertainty_covers():
    """The share of many that is covered: tests/soak/test_clock_offset.py."""
    for seed in range(2):
        found = estimate_clock_offset(*campaign(np.random.default_rng(seed), cycles=3), feed_mm_per_min=300)
        assert abs(found.offset_s - 37.0) < 3 * found.offset_u_s < 0.5


@pytest.mark.parametrize("read_after_s", [0.0, 1.0, 2.0])
def test_instant_of_the_reading_within_the_stand_is_in_the_uncertainty(read_after_s):
    """The table stands for 2 s: read on arrival, in the middle or before it goes on, the motion looks the same."""
    frames, seen, u, readings, targets = campaign(np.random.default_rng(4), cycles=3)
    earlier = np.round(1e3 * (2.0 - read_after_s)).astype(int) * np.timedelta64(1, "ms")
    found = estimate_between_clocks(frames, seen, u, readings - earlier, targets, feed_mm_per_min=300)
    assert abs(found.offset_s - 37.0) < 2 * found.offset_u_s
    assert found.offset_u_s == pytest.approx(2.0 / np.sqrt(12), rel=0.05)


# The last one meets the motion at one phase only: offset and feed are any of a line of pairs.
@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.slow), 1004])
def test_frames_at_few_phases_of_the_motion_leave_the_offset_open_and_say_so(seed):
    """Every 10 s of a motion that repeats every 6 s: two frames of three show the table standing; feed and offset share the third."""
    arguments = campaign(np.random.default_rng(seed), cycles=3, interval_s=10.0)
    found = estimate_clock_offset(*arguments)
    assert abs(found.offset_s - 37.0) < 2 * found.offset_u_s
    known = estimate_clock_offset(*arguments, feed_mm_per_min=300)
    assert known.offset_s == pytest.approx(37.0, abs=0.1)


def test_feed_zero_and_rate_are_found_too(rng):
    found = estimate_clock_offset(*campaign(rng, cycles=16, rate=50e-6))
    assert found.feed_mm_per_min == pytest.approx(300, rel=0.005)
    assert found.start_mm == pytest.approx(40.0, abs=0.05)
    assert found.rate == pytest.approx(50e-6, abs=4 * found.rate_u)
    assert found.rate_u < 20e-6
    assert found.rms_mm == pytest.approx(0.1, rel=0.2)


def test_given_feed_is_kept_and_short_records_have_no_rate(rng):
    found = estimate_clock_offset(*campaign(rng, cycles=2), feed_mm_per_min=300)
    assert found.feed_mm_per_min == 300
    assert found.rate == found.rate_u == 0
    assert found.offset_s == pytest.approx(37.0, abs=0.1)


def test_commanded_position_stands_reads_and_goes_on():
    at = np.array([-1.0, 0.0, 1.0, 4.0, 5.0, 6.0, 7.0])
    path = commanded_position(at, np.array([0.0, 6.0]), np.array([0.0, 20.0]), FEED_MM_S)
    np.testing.assert_allclose(path, [np.nan, 0, 5, 20, 20, 20, np.nan])
    on_arrival = commanded_position(at, np.array([0.0, 6.0]), np.array([0.0, 20.0]), FEED_MM_S, reading_phase=0.0)
    np.testing.assert_allclose(on_arrival, [np.nan, 0, 0, 10, 15, 20, np.nan])


def test_a_still_table_determines_nothing(rng):
    frames, seen, u, readings, targets = campaign(rng)
    with pytest.raises(ClockError, match=r"frames of a still table do not determine a clock offset; give clock_offset"):
        estimate_clock_offset(frames, rng.normal(0, 0.1, seen.size), u, readings, targets)


def filmed_from_long_before_to_long_after() -> tuple[tuple, float]:
    """Arguments of a periodic test of which the middle half was measured, and its period, s."""
    reading_s, reading_mm, way_s, way_mm = positioning_test(12)
    middle = (reading_s >= way_s[3 * 64]) & (reading_s < way_s[9 * 64])
    frame_s = np.arange(0, way_s[-1], 10.0)
    seen = np.interp(frame_s, way_s, way_mm)
    stamps = [T0 + (1e9 * s).astype("m8[ns]") for s in (frame_s, reading_s[middle])]
    return (stamps[0], seen, np.full(seen.size, 0.1), stamps[1], reading_mm[middle]), float(way_s[64] - way_s[0])


def test_of_the_offsets_of_a_periodic_test_the_smallest_is_taken_and_the_others_are_named():
    """Nobody knows what the table did outside the readings, so that any whole cycle fits as well."""
    arguments, period_s = filmed_from_long_before_to_long_after()
    found = estimate_clock_offset(*arguments, feed_mm_per_min=300)
    assert found.offset_s == pytest.approx(0.0, abs=0.2)
    assert found.rivals_s
    # A frame every 10 s sees three phases of a motion that repeats every 6 s: without the feed, any of a line of offsets and feeds fits.
    open_feed = estimate_clock_offset(*arguments)
    assert open_feed.rms_mm < 0.1
    assert abs(open_feed.offset_s) < 2 * open_feed.offset_u_s
    assert open_feed.offset_u_s > 0.5
    # The search goes in steps of 0.5 s.
    cycles = np.array(found.rivals_s) / period_s
    np.testing.assert_allclose(cycles, np.round(cycles), atol=1.0 / period_s)
    assert estimate_clock_offset(*campaign(np.random.default_rng(1), cycles=3)).rivals_s == ()


def test_offsets_of_a_periodic_test_that_are_all_far_from_the_expected_one_are_refused():
    arguments, period_s = filmed_from_long_before_to_long_after()
    with pytest.raises(ClockError, match=r"fits clock offsets of .* s about equally well \(a periodic test\), none"):
        estimate_clock_offset(*arguments, expected_s=-800.0 - period_s, search_s=820.0 + period_s)


def test_another_time_zone_is_refused(rng):
    frames, seen, u, readings, targets = campaign(rng, offset_s=7200.0)
    with pytest.raises(ClockError, match=r"do not overlap within 900 s of an offset of 0 s; check the time zones"):
        estimate_clock_offset(frames, seen, u, readings, targets)
    found = estimate_clock_offset(frames, seen, u, readings, targets, expected_s=7200.0)
    assert found.offset_s == pytest.approx(7200.0, abs=0.2)


def test_too_few_frames_or_readings_are_refused(rng):
    frames, seen, u, readings, targets = campaign(rng)
    with pytest.raises(ClockError, match="the table is found in 10 frames; 20 are needed"):
        estimate_clock_offset(frames[:10], seen[:10], u[:10], readings, targets)
    with pytest.raises(ClockError, match="2 readings have a time"):
        estimate_clock_offset(frames, seen, u, readings[:2], targets[:2])
