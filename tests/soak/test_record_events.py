"""Events of simulated records: found, dated and sized in the channels that they happen in, and none where nothing happens.

THERMOFUSE_RUNS sets the number of records of each kind (6 by default), THERMOFUSE_FIRST_SEED the first seed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.drift_model.record import hold_out
from fusion.analysis.drift_model.record_data import reduce_record
from fusion.analysis.drift_model.record_events import Event, find_events
from tests.fusion.record_tables import table_of
from tests.soak.rates import campaigns, first_seed, rate
from tests.soak.simulator import Array, first_order, room, switched_load, walk

pytestmark = pytest.mark.slow

RUNS, FIRST_SEED = campaigns(6), first_seed(9000)
#: Least and largest duration of an event, as shares of a thirtieth of the record or, below 1, of a day where that is less, and the share of
#: it that happens at once; without one it is even, else what is left settles.
KINDS = {
    "at once": (0.0, 0.0, None),
    "minutes": (0.02, 0.2, None),
    "hours": (0.3, 1.0, None),
    "creep": (0.3, 1.0, 0.0),
    "settling": (0.1, 1.0, 0.5),
}
#: From this size on, in standard deviations of a reading and of what the channel wanders meanwhile, an event is to be found.
LARGE = 6.0
LONG = {"long": (1.0, 7.5, None), "long creep": (1.0, 7.5, 0.0)}


@dataclass(frozen=True)
class Happened:
    """An event: when it began and how long it took, s, its size in every channel, and how far these wander meanwhile, um."""

    onset_s: float
    duration_s: float
    size: Array
    wander_um: float

    @property
    def is_large(self) -> bool:
        """Whether it is to be found."""
        return float(np.abs(self.size).max()) >= LARGE * float(np.hypot(1.0, self.wander_um))


def simulated(rng: np.random.Generator, kinds: list[str], *, everywhere: bool) -> tuple[xr.Dataset, list[Happened]]:
    """12 to 800 h of 3 to 12 displacements that follow a load, a room and the day late, wander, and have noise of 1 um."""
    hours, readings = float(rng.choice([12.0, 36.0, 120.0, 800.0])), int(rng.integers(1200, 5000))
    channels, seconds = int(rng.integers(3, 13)), np.linspace(0.0, 3600.0 * hours, readings)
    load = switched_load(rng, seconds / seconds[-1] * 12 * 1500.0) if rng.random() < 0.6 else np.zeros(readings)
    day = np.sin(2.0 * np.pi * (seconds / 86_400.0 + rng.random())) * (hours > 24.0)
    sources = [
        rng.uniform(3.0, 10.0) * first_order(seconds, load, rng.uniform(30.0, 120.0)),
        rng.uniform(0.5, 3.0) * (day - day[0]),
        rng.uniform(0.3, 1.5) * room(rng, seconds, rng.uniform(60.0, 480.0)),
    ]
    body, wander = np.column_stack(sources), rng.uniform(0.2, 4.0) / np.sqrt(hours)

    def late(shares: Array, minutes: float) -> Array:
        return first_order(seconds, (body - body[0]) @ shares, minutes)

    temperature = [late(rng.uniform(0.0, 1.0, 3), rng.uniform(0.2, 10.0)) for _ in range(int(rng.integers(2, 6)))]
    response = [late(rng.normal(0.0, 2.0, 3), rng.uniform(2.0, 60.0)) for _ in range(channels)]
    in_common = rng.uniform(0.0, 1.0)
    common = in_common * walk(rng, seconds, wander)
    steps = 0.5 * wander * np.sqrt(hours / readings) * rng.standard_t(4, (readings, channels))
    displacement = np.column_stack([one + common + walk(rng, seconds, wander) for one in response])
    displacement += np.cumsum(steps, axis=0) + rng.standard_normal((readings, channels))
    happened: list[Happened] = []
    for number, kind in enumerate(kinds):
        least, largest, at_once = {**KINDS, **LONG}[kind]
        duration_s = rng.uniform(least, largest) * min(np.inf if kind in LONG else 86_400.0, seconds[-1] / 30.0)
        # Each in a part of its own of the time before the hold-out.
        room_s = 0.7 * seconds[-1] - duration_s if kind in LONG else 0.6 * seconds[-1]
        onset_s = 0.1 * seconds[-1] + room_s * (number + rng.uniform(0.1, 0.8)) / len(kinds)
        after = np.maximum(seconds - onset_s, 0.0) / max(duration_s, 1e-9)
        course = np.minimum(after, 1.0) if at_once is None else 1.0 - (1.0 - at_once) * np.exp(-3.0 * after)
        size, which = np.zeros(channels), rng.permutation(channels)[: channels if everywhere else rng.integers(1, 3)]
        size[which] = np.exp(rng.uniform(np.log(2.0), np.log(20.0))) * rng.choice([-1.0, 1.0])
        size[which] *= rng.uniform(0.7, 1.3, which.size)
        displacement += np.where(seconds >= onset_s, course, 0.0)[:, None] * size
        # Steps of Student's t with 4 degrees of freedom have twice the variance.
        moves = wander * np.sqrt((1.0 + in_common**2 + 0.5) * duration_s / 3600.0)
        happened.append(Happened(onset_s, duration_s, size, float(moves)))
    logged = 20.0 + np.column_stack(temperature) + 0.02 * rng.standard_normal((readings, len(temperature)))
    return table_of(displacement, logged, load if load.any() else None, step_s=float(seconds[1])), happened


def events(table: xr.Dataset) -> list[Event]:
    record = reduce_record(table)
    return find_events(record, hold_out(record)[0])[0]


def is_of(event: Event, one: Happened, step_s: float) -> bool:
    """Whether an event is at the time, and in a channel, of one that happened."""
    begins, ends = event.onset.low - 0.25 * one.duration_s, event.onset.value + event.duration.value
    is_then = begins <= one.onset_s + one.duration_s and ends + 0.25 * one.duration_s + 2.0 * step_s >= one.onset_s
    return is_then and bool((event.size[one.size != 0.0] != 0.0).any())


def test_events_are_found_dated_and_sized_and_none_is_where_nothing_happens(capsys: pytest.CaptureFixture[str]) -> None:
    large, dated, lasted, sized, false = ([] for _ in range(5))
    for number, kind in enumerate(("none", *KINDS, "in all channels", "several", *LONG)):
        for seed in range(FIRST_SEED, FIRST_SEED + RUNS):
            rng = np.random.default_rng([seed, number])
            several = [str(one) for one in rng.choice([*KINDS], int(rng.integers(2, 4)))]
            planted = {"none": [], "in all channels": ["at once"], "several": several}.get(kind, [kind])
            table, happened = simulated(rng, planted, everywhere=kind == "in all channels")
            step_s, left = float(np.diff(table["time"].values[:2])[0] / np.timedelta64(1, "s")), events(table)
            for one in happened:
                found = next((event for event in left if is_of(event, one, step_s)), None)
                large += [found is not None] if one.is_large else []
                if found is not None:
                    left = [event for event in left if event is not found]
                    dated.append(found.onset.low <= one.onset_s <= found.onset.high)
                    lasted.append(found.duration.low <= one.duration_s <= found.duration.high)
                    sized += (np.abs(found.size - one.size) <= 2.0 * found.size_u)[found.size != 0.0].tolist()
            false.append(bool(left))
        with capsys.disabled():
            told = {"large found": large, "onset": dated, "duration": lasted, "size": sized, "false records": false}
            print(f"{kind}, all so far: " + "; ".join(f"{name} {sum(one)}/{len(one)}" for name, one in told.items()))
            print(f"large found {rate(sum(large), max(1, len(large)))}; false records {rate(sum(false), len(false))}")
    assert np.mean(false) <= 0.02 + 3.0 * np.sqrt(0.02 / len(false))
    # Intervals of 95 % and 2 u, less three standard deviations of a count of some fifty.
    assert np.mean(large) >= 0.6 and np.mean(dated) >= 0.85 and np.mean(sized) >= 0.88
