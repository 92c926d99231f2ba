"""Readings that lie: signs, labels, numbers, copies, gaps, jumps of the datum, outliers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd

from tests.soak.lies.campaigns import CYCLES, HALF, TARGETS
from tests.soak.lies.folder import Plant, edit_table
from tests.soak.lies.lie import Lie

SIGN = r"\bsign"
APPROACH = r"approach|direction"
NUMBERS = r"cycle.*(number|begins|order)"
COPIED = r"cop(y|ies|ied)|digit for digit|twice|already occurs|repeat|begins at"
MISSING = r"missing|left out|only|gap"
DATUM = r"datum|zero|jump|step|beam|shift"
OUTLIER = r"outlier|beyond|far off|magnitude|gross|reading.{0,60}(off|away|set aside|left out)"
TARGETS_NAMED = r"target|position"
RESOLUTION = r"resolution|rounded|digits|repeat|alike"
#: Cycles of the block at the end, which the hold-out covers, and of the block in the middle that is lost.
_LAST, _LOST = range(CYCLES - 6, CYCLES + 1), range(15, 22)
_COPIED, _SLIPPED = 15, 19


def laser(edit: Callable[[pd.DataFrame], pd.DataFrame]) -> Plant:
    return edit_table("laser.csv", edit)


def added(rows: Callable[[pd.DataFrame], pd.Series], um: float) -> Plant:
    """Add to the readings of some rows."""
    return laser(lambda table: table.assign(deviation_um=table["deviation_um"] + um * rows(table)))


def kept(rows: Callable[[pd.DataFrame], pd.Series]) -> Plant:
    """Keep some rows."""
    return laser(lambda table: table[rows(table)])


def drawn(table: pd.DataFrame, number: int) -> np.ndarray:
    """Draw rows at random, always the same."""
    return np.random.default_rng(3).choice(len(table), number, replace=False)


def inverted(rows: Callable[[pd.DataFrame], pd.Series]) -> Plant:
    """Invert the sign of some rows."""
    return laser(
        lambda table: table.assign(deviation_um=table["deviation_um"].where(~rows(table), -table["deviation_um"]))
    )


def swapped_approaches(first_cycle: int) -> Plant:
    other = {"positive": "negative", "negative": "positive"}
    return laser(
        lambda t: t.assign(direction=t["direction"].where(t["cycle"] < first_cycle, t["direction"].map(other)))
    )


def copied_cycle(number: int) -> Callable[[pd.DataFrame], pd.DataFrame]:
    return lambda table: pd.concat([table, table[table["cycle"] == _COPIED].assign(cycle=number)], ignore_index=True)


def values_of_the_cycle_before(table: pd.DataFrame) -> pd.DataFrame:
    table.loc[table["cycle"] == _COPIED + 1, "deviation_um"] = table.loc[
        table["cycle"] == _COPIED, "deviation_um"
    ].to_numpy()
    return table


def exchanged_cycles(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(cycle=table["cycle"].replace({14: 28, 28: 14}))


def outliers(number: int, um: float) -> Plant:
    def edit(table: pd.DataFrame) -> pd.DataFrame:
        chosen = drawn(table, number)
        values = table["deviation_um"].to_numpy().copy()
        values[chosen] += um * np.where(np.arange(number) % 2, -1.0, 1.0)
        return table.assign(deviation_um=values)

    return laser(edit)


def zeroed_in_every_cycle(table: pd.DataFrame) -> pd.DataFrame:
    first = table.groupby("cycle")["deviation_um"].transform("first")
    return table.assign(deviation_um=(table["deviation_um"] - first).round(4))


def positions_reversed(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(position_mm=(table["position_mm"].max() - table["position_mm"]).round(4))


def targets_reversed_in_one_approach(table: pd.DataFrame) -> pd.DataFrame:
    """Number the targets of one approach from the other end: their readings change places, with their times."""
    other = table.assign(target=TARGETS + 1 - table["target"])[["cycle", "direction", "target", "deviation_um"]]
    joined = table.drop(columns="deviation_um").merge(other, on=["cycle", "direction", "target"])
    values = joined.set_index(["cycle", "direction", "target"])["deviation_um"]
    keys = pd.MultiIndex.from_frame(table[["cycle", "direction", "target"]])
    reversed_um = pd.Series(values.reindex(keys).to_numpy(), index=table.index)
    return table.assign(deviation_um=table["deviation_um"].where(table["direction"] == "positive", reversed_um))


def positions_shifted(table: pd.DataFrame) -> pd.DataFrame:
    spacing = table["position_mm"].max() / (TARGETS - 1)
    return table.assign(position_mm=(table["position_mm"] + spacing).round(4))


def exchanged_targets(table: pd.DataFrame) -> pd.DataFrame:
    place = {target: float(rows["position_mm"].iloc[0]) for target, rows in table.groupby("target")}
    place[2], place[7] = place[7], place[2]
    return table.assign(position_mm=table["target"].map(place))


def of_the_neighbour(table: pd.DataFrame) -> pd.DataFrame:
    """Target 7 holds what target 6 reads."""
    here, neighbour = table["target"] == 7, table["target"] == 6
    keys = ["cycle", "direction"]
    values = table[neighbour].set_index(keys)["deviation_um"]
    read = values.reindex(pd.MultiIndex.from_frame(table.loc[here, keys])).to_numpy()
    table.loc[here, "deviation_um"] = read
    return table


def clipped(table: pd.DataFrame) -> pd.DataFrame:
    """The largest 30 % of the readings are one value."""
    return table.assign(deviation_um=table["deviation_um"].clip(upper=round(table["deviation_um"].quantile(0.7), 3)))


def one_target_late(table: pd.DataFrame) -> pd.DataFrame:
    """From cycle 19 on, a trigger was missed: every reading is that of the target before, in the order of the times."""
    table = table.sort_values("time", kind="stable")
    late = table["deviation_um"].shift(1, fill_value=0.0)
    return table.assign(deviation_um=table["deviation_um"].where(table["cycle"] < _SLIPPED, late))


def set_to_zero(table: pd.DataFrame) -> pd.DataFrame:
    """The laser was set to zero at the first reading of the second half."""
    late = table["cycle"] >= HALF
    zero = table.loc[late, "deviation_um"].iloc[0]
    return table.assign(deviation_um=table["deviation_um"] - zero * late)


def with_play(table: pd.DataFrame) -> pd.DataFrame:
    """A common drift with play: it follows the slow course of the readings only after they moved by 1 µm."""
    level = table.groupby("cycle")["deviation_um"].mean()
    held, followed = float(level.iloc[0]), []
    for value in level:
        held = min(max(held, value - 1.0), value + 1.0)
        followed.append(held)
    added_um = table["cycle"].map(dict(zip(level.index, np.array(followed) - followed[0], strict=True)))
    return table.assign(deviation_um=(table["deviation_um"] + 0.5 * added_um).round(4))


LIES = (
    Lie("sign of the deviations inverted", SIGN, inverted(lambda t: t["cycle"] > 0)),
    Lie("sign inverted in the second half", SIGN, inverted(lambda t: t["cycle"] >= HALF)),
    Lie("sign of target 5 inverted", SIGN + "|target 5", inverted(lambda t: t["target"] == 5), targets=frozenset({5})),
    Lie("sign of one approach inverted", SIGN + "|approach", inverted(lambda t: t["direction"] == "negative")),
    Lie("approach labels swapped everywhere", APPROACH, swapped_approaches(0)),
    Lie("approach labels swapped in the second half", APPROACH, swapped_approaches(HALF)),
    Lie("targets numbered from the other end", TARGETS_NAMED, laser(positions_reversed)),
    Lie("targets of one approach numbered from the other end", TARGETS_NAMED, laser(targets_reversed_in_one_approach)),
    Lie(
        "target list shifted by one",
        TARGETS_NAMED,
        laser(positions_shifted),
        limit="a line shifted by one target explains these readings as well as the right one does: no alternative gains in log-likelihood",
    ),
    Lie("places of targets 2 and 7 exchanged", TARGETS_NAMED, laser(exchanged_targets)),
    Lie("cycles numbered from 0", NUMBERS, laser(lambda t: t.assign(cycle=t["cycle"] - 1)), renumbered=1),
    Lie("cycle 15 twice, same number", COPIED, laser(copied_cycle(_COPIED))),
    Lie("cycle 15 twice, as a new number at the end", COPIED, laser(copied_cycle(CYCLES + 1))),
    Lie("cycle 16 holds the values of cycle 15", COPIED, laser(values_of_the_cycle_before)),
    Lie("cycle numbers 14 and 28 exchanged", NUMBERS, laser(exchanged_cycles)),
    Lie("lines in random order", r"order", laser(lambda t: t.sample(frac=1.0, random_state=3))),
    Lie("30 % of readings missing", MISSING, laser(lambda t: t.drop(index=drawn(t, 3 * len(t) // 10)))),
    Lie("7 cycles missing in the middle", MISSING, kept(lambda t: ~t["cycle"].isin(_LOST))),
    Lie("target 5 missed every time", MISSING, kept(lambda t: t["target"] != 5)),
    Lie(
        "target 5 missed in one approach", MISSING, kept(lambda t: (t["target"] != 5) | (t["direction"] == "positive"))
    ),
    Lie("one approach only", MISSING, kept(lambda t: t["direction"] == "positive")),
    Lie("one reading of 1e6 µm", OUTLIER, outliers(1, 1e6)),
    Lie("ten readings 30 µm off", OUTLIER, outliers(10, 30.0)),
    Lie(
        "beam broken: +500 µm in the second half",
        DATUM,
        added(lambda t: t["cycle"] >= HALF, 500.0),
        describes=frozenset({"step_event"}),
    ),
    Lie(
        "last 7 cycles of another set-up: +20 µm",
        DATUM,
        added(lambda t: t["cycle"].isin(_LAST), 20.0),
        describes=frozenset({"step_event"}),
    ),
    Lie(
        "+5 µm at all targets from cycle 15 on",
        DATUM,
        added(lambda t: t["cycle"] >= _COPIED, 5.0),
        describes=frozenset({"step_event"}),
    ),
    Lie("laser set to zero at the start of every cycle", DATUM, laser(zeroed_in_every_cycle)),
    Lie("all deviations 0", RESOLUTION, laser(lambda t: t.assign(deviation_um=0.0))),
    Lie("target 7 holds the values of target 6", COPIED + "|target 7", laser(of_the_neighbour), targets=frozenset({7})),
    Lie("readings clipped at the 70th percentile", r"clipped|one value|largest value|range", laser(clipped)),
    Lie("a trigger missed from cycle 19 on", r"trigger|one target|target_order|neighbour", laser(one_target_late)),
    Lie("laser set to zero in the middle", DATUM, laser(set_to_zero), describes=frozenset({"step_event"})),
    Lie(
        "lines of cycle 20 twice",
        COPIED,
        laser(lambda t: pd.concat([t, t[t["cycle"] == 20]], ignore_index=True)),
    ),
    Lie("deviations rounded to 1 µm", RESOLUTION, laser(lambda t: t.assign(deviation_um=t["deviation_um"].round(0)))),
)
#: What is unusual and sound.
SOUND = (Lie("sound: drift with play", "$^", laser(with_play), describes=frozenset({"thermal_lag"})),)
