"""Hold-out set and declared model of a record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusion.effects.thermal import QUASI_STATIC, QUASI_STATIC_RESPONSE
from fusion.loop.closed_loop import HOLD_OUT_SHARE
from fusion.model.fit import Term
from fusion.record.blocks import Record, RecordError

#: Runs that a sentence names.
_MOST_NAMED = 4


def hold_out(record: Record) -> tuple[NDArray[np.bool_], str]:
    """Divide a record into a training part and a hold-out set: the runs that are held out, or the last fifth of the time of a single run.

    Parameters
    ----------
    record : on its blocks

    Returns
    -------
    train : (blocks,) True for the training part
    description : which time is held out, and how it is predicted

    Raises
    ------
    RecordError
        if no displacement was measured in the hold-out set.
    """
    train, description = _divide(record)
    if not np.isfinite(record.displacement[~train]).any():
        raise RecordError(
            f"no displacement was measured in what is held out ({description}); leave the end of the record out"
        )
    return train, description


def _divide(record: Record) -> tuple[NDArray[np.bool_], str]:
    """The training part and what is held out, in words."""
    if record.runs:
        held_out = np.array([one.held_out for one in record.runs])
        named, others = ([one.name for one in record.runs if one.held_out is out] for out in (True, False))
        return (
            ~held_out[record.run],
            f"{_named(named)} held out; coefficients from {_named(others)}, every run from its own zero; error is the mean over channels",
        )
    first = record.seconds[0] + (1.0 - HOLD_OUT_SHARE) * (record.seconds[-1] - record.seconds[0])
    hours = first / 3600.0, record.seconds[-1] / 3600.0
    return (
        record.seconds < first,
        f"{hours[0]:.1f} h to {hours[1]:.1f} h held out; coefficients from the time before, nothing re-zeroed; error is the mean over "
        "channels",
    )


def _named(runs: Sequence[str]) -> str:
    """Runs in words, the first of them by name."""
    shown = ", ".join(runs[:_MOST_NAMED]) + (f" and {len(runs) - _MOST_NAMED} more" if len(runs) > _MOST_NAMED else "")
    return f"run {shown}" if len(runs) == 1 else f"runs {shown}"


def declare(declared: Sequence[str], record: Record) -> list[Term]:
    """Make the terms of the declared model.

    Parameters
    ----------
    declared : names of effects; ``quasi_static`` is the only one that a record can be declared with
    record : on its blocks

    Raises
    ------
    RecordError
        if a name has no meaning for a record.
    """
    terms = []
    for name in declared:
        if name != QUASI_STATIC:
            raise RecordError(
                f'declared effect {name!r} cannot be computed from a record; declare "{QUASI_STATIC}" (every displacement linear '
                "in the temperatures), the search tries the rest of the library"
            )
        terms += [Term(QUASI_STATIC, one) for one in QUASI_STATIC_RESPONSE.candidates(record.view(), {}, None)]
    return terms
