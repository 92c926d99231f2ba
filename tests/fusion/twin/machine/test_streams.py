"""Named random streams, loads with their stated holds, and a lag that is exact for a stepwise constant drive."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.twin.machine.streams import first_order, random_levels, stream, switched_levels

TIME_S = np.arange(0.0, 400 * 3600.0, 10.0)


def holds_min(level: np.ndarray) -> np.ndarray:
    """Times for which a level was held, the first and the last left out, min."""
    changes = np.flatnonzero(np.diff(level))
    return np.diff(TIME_S[changes]) / 60.0


def test_stream_depends_on_seed_and_name_only():
    draw = stream(4, "noise").standard_normal(5)
    np.testing.assert_array_equal(stream(4, "noise").standard_normal(5), draw)
    assert not np.array_equal(stream(4, "profile").standard_normal(5), draw)
    assert not np.array_equal(stream(5, "noise").standard_normal(5), draw)


def test_random_levels_are_held_between_0_4_and_1_6_of_the_mean(rng):
    level = random_levels(TIME_S, 0.2, 0.9, 30.0, rng)
    hold = holds_min(level)
    step = 10.0 / 60.0
    assert hold.min() >= 12.0 - step
    assert hold.max() <= 48.0 + step
    # some 800 holds with a standard deviation of 10.4 min know their mean to 0.4 min
    assert hold.mean() == pytest.approx(30.0, abs=1.5)
    # uniform levels between 0.2 and 0.9
    assert level.mean() == pytest.approx(0.55, abs=0.03)


def test_alternate_levels_take_turns(rng):
    level = random_levels(TIME_S, 0.2, 0.9, 30.0, rng, alternate=True)
    assert set(level.tolist()) == {0.2, 0.9}
    assert holds_min(level).min() >= 12.0 - 10.0 / 60.0


def test_switched_levels_have_a_minimum_hold_and_an_exponential_rest(rng):
    hold = holds_min(switched_levels(TIME_S, (0.0, 1.0), (600.0, 1200.0), rng))
    assert hold.min() >= 10.0 - 10.0 / 60.0
    # some 800 holds of 10 min + Exp(20 min): mean and standard deviation of the rest are equal, known to 4 % and 5 %
    assert hold.mean() == pytest.approx(30.0, abs=3.0)
    assert hold.std() == pytest.approx(20.0, rel=0.2)


@pytest.mark.parametrize("step_s", [10.0, 60.0, 300.0])
def test_first_order_is_exact_for_a_constant_drive_at_any_step(step_s):
    t = np.arange(0.0, 3600.0, step_s)
    np.testing.assert_allclose(
        first_order(np.full(t.size, 2.0), step_s, 900.0), 2.0 * (1.0 - np.exp(-t / 900.0)), atol=1e-12
    )


def test_first_order_attenuates_and_delays_a_sine_as_a_low_pass_does():
    period_s, tau_s = 3600.0, 900.0
    t = np.arange(0.0, 20 * period_s, 1.0)
    omega = 2 * np.pi / period_s
    settled = first_order(np.sin(omega * t), 1.0, tau_s)[10 * int(period_s) :]
    transfer = 1.0 / (1.0 + 1j * omega * tau_s)
    expected = np.abs(transfer) * np.sin(omega * t + np.angle(transfer))[10 * int(period_s) :]
    # a drive held over steps of 1 s lags half a second more: omega / 2
    np.testing.assert_allclose(settled, expected, atol=1e-3)
