"""What was recorded when, as bars of text on one time axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.report.wording import duration

_FULL, _EMPTY = "█", "·"
#: Samples further apart than this many times their usual distance have a gap between them.
_GAP_STEPS = 10.0
#: Times before this one count from a start that is not stated.
_NO_DATE = np.datetime64("1980-01-01")


@dataclass(frozen=True)
class Recording:
    """One recording of a campaign.

    Attributes
    ----------
    name : str
        What was recorded.
    times : (n,) ndarray of datetime64
        Its samples, UTC, on the laser's clock; empty where it has no times.
    """

    name: str
    times: NDArray[np.datetime64]

    def stretches(self) -> list[tuple[np.datetime64, np.datetime64]]:
        """Return start and end of every stretch without a gap."""
        times = np.sort(self.times[~np.isnat(self.times)]).astype("datetime64[ns]")
        if times.size == 0:
            return []
        steps = np.diff(times).astype(np.int64)
        moving = steps[steps > 0]
        usual = float(np.median(moving)) if moving.size else 0.0
        cuts = np.flatnonzero(steps > _GAP_STEPS * usual) if usual else np.array([], dtype=int)
        starts, ends = np.concatenate([[0], cuts + 1]), np.concatenate([cuts, [times.size - 1]])
        return list(zip(times[starts], times[ends], strict=True))


def time_bars(recordings: Sequence[Recording], *, width: int = 60) -> list[str]:
    """Return a bar per recording, filled where it has samples, above one time axis.

    Parameters
    ----------
    recordings : sequence of Recording
        Those without times are named as such.
    width : int
        Characters of a whole bar.

    Returns
    -------
    list of str
        Lines of text: a bar for each recording with its number of stretches where there are gaps, then the axis; empty where nothing
        has a time.
    """
    stretches = {recording.name: recording.stretches() for recording in recordings}
    ends = [end for parts in stretches.values() for part in parts for end in part]
    if not ends:
        return []
    first, last = min(ends), max(ends)
    label = max(len(name) for name in (*stretches, "UTC"))
    lines = [
        f"{name:<{label}}  {_bar(parts, first, last, width)}{_gap_words(parts)}" for name, parts in stretches.items()
    ]
    length = duration(float((last - first) / np.timedelta64(1, "s")))
    if first < _NO_DATE:
        return [*lines, f"{'':<{label}}  {'start':<{width - len(length)}}{length}"]
    left, right = (np.datetime_as_string(time, unit="m").replace("T", " ") for time in (first, last))
    middle = f"{length:^{max(width - len(left) - len(right), 0)}}"
    return [*lines, f"{'UTC':<{label}}  {left}{middle}{right}"]


def _bar(
    parts: Sequence[tuple[np.datetime64, np.datetime64]], first: np.datetime64, last: np.datetime64, width: int
) -> str:
    """Return a bar whose characters are filled where a stretch touches their share of the time."""
    if not parts:
        return f"{'no times':{_EMPTY}<{width}}"
    whole = max(float((last - first) / np.timedelta64(1, "ns")), 1.0)
    filled = np.zeros(width, dtype=bool)
    for start, end in parts:
        low, high = (float((time - first) / np.timedelta64(1, "ns")) / whole * width for time in (start, end))
        filled[min(int(low), width - 1) : max(int(np.ceil(high)), int(low) + 1)] = True
    return "".join(_FULL if is_filled else _EMPTY for is_filled in filled)


def _gap_words(parts: Sequence[tuple[np.datetime64, np.datetime64]]) -> str:
    gaps = len(parts) - 1
    return "" if gaps < 1 else f"  {gaps} gap{'s' if gaps > 1 else ''}"
