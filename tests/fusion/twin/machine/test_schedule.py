"""The schedule of the test: one reading per target and direction in each cycle, at the feed and dwell of the recipe."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.twin.machine.recipe import Duty, RecipeError
from fusion.twin.machine.recipe import Test as PositioningTest
from fusion.twin.machine.schedule import duty_levels, make_schedule
from fusion.twin.recipe_file import packaged_recipe, read_recipe
from fusion.twin.simulate import simulate


def test_paper_lasts_seven_hours():
    truth = simulate(read_recipe(packaged_recipe("paper")))
    assert truth.schedule.duration_s == pytest.approx(7 * 3600.0)
    step = np.diff(truth.session.time_s[:16])
    np.testing.assert_allclose(step, 20.0 / 5.0 + 2.0)


def test_every_target_is_read_once_per_direction_and_cycle():
    schedule = make_schedule(PositioningTest(cycles=3, targets=5), seed=1)
    visits = set(zip(schedule.cycle.tolist(), schedule.sign.tolist(), schedule.target.tolist(), strict=True))
    assert len(visits) == schedule.time_s.size == 3 * 2 * 5
    assert np.all(np.diff(schedule.time_s) > 0)
    np.testing.assert_array_equal(schedule.positions_mm[schedule.target - 1], schedule.position_mm)


def test_table_stands_at_the_target_through_the_dwell_and_moves_at_the_feed():
    test = PositioningTest(cycles=2, positions_mm=(5.0, 25.0, 60.0), feed_mm_per_min=600.0, dwell_s=3.0, period_s=60.0)
    schedule = make_schedule(test, seed=1)
    for before_s in (0.0, 1.5, 3.0):
        np.testing.assert_allclose(schedule.table_position(schedule.time_s - before_s), schedule.position_mm, atol=1e-9)
    # one second before the dwell it is 10 mm short of the target at 600 mm/min, on the side it comes from
    forward = schedule.sign > 0
    short = schedule.position_mm - schedule.table_position(schedule.time_s - 4.0)
    np.testing.assert_allclose(short[forward & (schedule.target > 1)], 10.0, atol=1e-9)
    np.testing.assert_allclose(short[~forward & (schedule.target < 3)], -10.0, atol=1e-9)
    assert schedule.table_position(np.array([59.9]))[0] == 0.0


def test_cycles_repeat_with_the_period():
    schedule = make_schedule(PositioningTest(cycles=4, period_s=300.0), seed=1)
    np.testing.assert_allclose(schedule.time_s[schedule.cycle == 3] - schedule.time_s[schedule.cycle == 1], 600.0)
    assert (schedule.start_of(3), schedule.duration_s) == (600.0, 1200.0)
    assert schedule.last_reading_s == schedule.time_s[31]


def test_jitter_spares_the_first_and_the_last_target():
    positions = make_schedule(PositioningTest(jitter_mm=3.0), seed=1).positions_mm
    offset = positions - 20.0 * np.arange(16)
    assert offset[0] == offset[-1] == 0.0
    assert 1.0 < np.abs(offset).max() <= 3.0


def test_cycle_longer_than_its_period_is_refused():
    with pytest.raises(RecipeError, match=r"test\.period_s = 50\.0 is shorter than one cycle, 1\d\d\.\d s; raise it"):
        make_schedule(PositioningTest(period_s=50.0), seed=1)


@pytest.mark.parametrize(
    ("kind", "levels"), [("constant", {0.8}), ("switched", {0.2, 0.8}), ("randomised", {0.2, 0.8}), ("random", None)]
)
def test_duty_keeps_to_its_levels(kind, levels):
    duty = duty_levels(Duty(kind=kind, low=0.2, high=0.8, mean_hold_min=5.0), np.arange(0.0, 36000.0, 10.0), seed=2)
    assert duty.min() >= 0.2
    assert duty.max() <= 0.8
    assert levels is None or set(duty.tolist()) == levels
