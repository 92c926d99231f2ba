"""What a watch prints of a cycle."""

from __future__ import annotations

import numpy as np

from fusion.pipeline.watch.state import Enough, FinishedCycle, LiveState, live_line

NAT = np.datetime64("NaT", "ns")


def line(**of_cycle: object) -> str:
    plain = {"frames": 0, "field": None, "field_range_degC": None, "rise_K": np.nan, "drift_um": np.zeros(0)}
    cycle = FinishedCycle(4, NAT, NAT, **{**plain, **of_cycle})  # type: ignore[arg-type]
    return live_line(LiveState(3, 40, 4, cycle, {}, "", None, ()))


def test_a_line_holds_what_is_known() -> None:
    assert line() == "cycle 4: nothing that can be used"
    assert line(frames=2) == "cycle 4: 2 frames, no field"
    assert line(drift_um=np.array([1.0, np.nan, -2.0])) == "cycle 4: drift -0.50 µm"
    assert (
        line(frames=1, field_range_degC=(20.0, 21.5), rise_K=0.25)
        == "cycle 4: 1 frame, 20.00 to 21.50 degC, rise 0.25 K"
    )


def test_enough_needs_both_the_uncertainty_and_the_least_length() -> None:
    assert Enough(20, 0.05, 12, "").is_enough
    assert not Enough(11, 0.05, 12, "").is_enough
    assert not Enough(20, 0.05, 12, "Measure at least 12 cycles.").is_enough


def test_mean_drift_of_nothing_is_unknown() -> None:
    assert np.isnan(FinishedCycle(1, NAT, NAT, 0, None, None, np.nan, np.array([np.nan])).mean_drift_um)
