"""How often the closed loop names what is missing, on campaigns of the twin: docs/method/closed-loop.md, tables of error rates.

THERMOFUSE_RUNS sets the number of campaigns per case. The quoted figures are from THERMOFUSE_FIRST_SEED=23001 and 100 campaigns per case
(19 or 20 for the effects of half the size, 33 or 34 for the pairs); the default seeds, from 7000 on, are others on which nothing was
tuned either. A rate misses its bar where the whole interval lies on the wrong side of it, so that few campaigns do not decide.

A name is asked for only in campaigns that could tell: before it searches, the loop says from which size on the typical candidate of every
effect would be found; its best one may have another shape than what is planted. A lag of this slow table and a wrong material coefficient
hide beside the declared model and the drift in nearly all of them; there only a wrong name counts. The quoted figures count all campaigns.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.loop_bench import SHAPES, Outcome, examine
from tests.soak import rates
from tests.soak.rates import campaigns, first_seed, wilson

pytestmark = pytest.mark.slow
RUNS = campaigns(100)
FIRST_SEED = first_seed(7000)
LIBRARY = {
    "reversal_drift": 0.85,
    "unseen_heat_source:flat": 0.85,
    "unseen_heat_source:linear": 0.85,
    "air_index": 0.85,
    "dead_path": 0.85,
    "step_event": 0.85,
    "periodic_disturbance": 0.85,
    "pitch_error": 0.85,
    "angular_growth": 0.85,
    "camera_offset": 0.85,
    "reflected_source": 0.85,
    "sensor_fault": 0.85,
    "thermal_lag": 0.75,
    "laser_warm_up": 0.85,
    "material_compensation": 0.85,
}
#: Campaigns from which the median of their errors is held.
_ENOUGH_NAMED = 20
PAIRS = (("air_index", "reversal_drift"), ("step_event", "reversal_drift"), ("unseen_heat_source:flat", "step_event"))


def outcomes(names: tuple[str, ...], rms_um: float) -> list[Outcome]:
    return [examine(names, rms_um, FIRST_SEED + number) for number in range(RUNS)]


def rate(count: int, of: int = RUNS) -> str:
    return rates.rate(count, of, digits=2)


def could_tell(one: Outcome, name: str, rms_um: float) -> bool:
    """Whether the loop said beforehand that an effect of this size could be found."""
    effect = name.partition(":")[0]
    limits = [limit for scored in one.found.state.rounds for limit in scored.detection_limits]
    typical = [limit.detectable_um for limit in limits if limit.effect == effect]
    return bool(typical) and typical[0] is not None and typical[0] <= rms_um


def show(title: str, found: list[Outcome], missing: int) -> None:
    """Print one row of the table."""
    verdicts = {
        name: sum(one.found.verdict == name for one in found)
        for name in ("complete", "explained", "partial", "unexplained", "no_skill")
    }
    after = [one.after_over_floor for one in found]
    before = [one.before_over_floor for one in found]
    print(
        f"\n{title}: N {RUNS}, seen beside the declared model {np.mean([one.visible_um for one in found]):.2f} um rms; "
        f"alone {rate(sum(one.right == missing and not one.tied for one in found) if missing else 0)}, "
        f"or in a stated tie {rate(sum(one.right == missing for one in found) if missing else 0)}, "
        f"wrong {rate(sum(one.wrong > 0 for one in found))}, none {rate(sum(one.nothing for one in found))}; {verdicts}; "
        f"error over floor {np.median(before):.2f} -> {np.median(after):.2f}, 90 % below {np.quantile(after, 0.9):.2f}"
    )


@pytest.mark.parametrize("name", list(LIBRARY))
def test_one_missing_effect_is_named(name):
    found = outcomes((name,), 0.4)
    show(f"{name}, 0.4 um", found, 1)
    asked = [one for one in found if could_tell(one, name, 0.4)]
    right = sum(one.right == 1 for one in asked)
    print(f"  of {len(asked)} campaigns that could tell: {rate(right, len(asked)) if asked else '-'}")
    assert not asked or wilson(right, len(asked))[1] >= LIBRARY[name]
    assert wilson(sum(one.wrong > 0 for one in found), RUNS)[0] <= 0.05
    named = [one.after_over_floor for one in found if one.right]
    # A step before the hold-out is known to the carried drift, and what is found in all cycles has no held-out error.
    # The median of fewer scatters by more than the 5 % that are asked for.
    assert len(named) < _ENOUGH_NAMED or np.median(named) <= 1.05


@pytest.mark.parametrize("name", list(LIBRARY))
def test_half_as_large_an_effect_gets_no_wrong_name(name):
    found = outcomes((name,), 0.2)
    show(f"{name}, 0.2 um", found, 1)
    assert wilson(sum(one.wrong > 0 for one in found), RUNS)[0] <= 0.05


def test_where_nothing_is_missing_nothing_is_added():
    found = outcomes((), 0.0)
    show("nothing missing", found, 0)
    assert wilson(sum(not one.nothing for one in found), RUNS)[0] <= 0.06


@pytest.mark.parametrize("names", PAIRS, ids=" and ".join)
def test_two_missing_effects_are_both_found(names):
    found = outcomes(names, 0.4)
    show(" and ".join(names) + ", 0.4 um each", found, 2)
    assert wilson(sum(one.right == 2 for one in found), RUNS)[1] >= 0.6


@pytest.mark.parametrize("name", list(SHAPES))
def test_what_is_not_in_the_library_gets_no_name_but_a_description(name):
    found = outcomes((name,), 0.4)
    described = sum(
        one.found.verdict in {"unexplained", "partial"}
        and all(words in one.found.remainder.shape for words in SHAPES[name])
        for one in found
    )
    explained = sum(one.wrong > 0 and one.found.verdict == "explained" for one in found)
    show(f"{name} (outside the library), 0.4 um", found, 1)
    print(f"  shape right {rate(described)}, wrongly explained {rate(explained)}")
    assert wilson(described, RUNS)[1] >= 0.85
    assert wilson(explained, RUNS)[0] <= 0.10
