"""The closed loop on whatever was measured: readings along an axis, or a record of sensors and displacements."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import xarray as xr

from fusion.analysis.alignment.readings import Readings, read_fused
from fusion.analysis.drift_model.axis import close_axis
from fusion.analysis.drift_model.evaluation import LoopResult
from fusion.analysis.drift_model.record import close_record
from fusion.analysis.drift_model.record_data import Record
from fusion.analysis.drift_model.search import Progress, no_progress
from fusion.analysis.effects.effect import Effect


def close_loop(
    measured: xr.Dataset | Readings | Record,
    declared: Sequence[str],
    *,
    seed: int = 1,
    set_aside: Collection[tuple[int, str]] = (),
    effects: Mapping[str, Effect] | None = None,
    progress: Progress = no_progress,
) -> LoopResult:
    """Close the loop on a positioning campaign or on a record.

    Parameters
    ----------
    measured : Dataset, Readings or Record
        What `align` returns: readings in um, and the rises and logs beside them; or its readings in the order of time, as `read_fused`
        returns them; or a record as `reduce_record` returns it.
    declared : sequence of str
        Names of the effects the user believes to act, such as ``["axis_expansion", "table_offset"]``, of a record ``["quasi_static"]``.
    seed : int
        Of the simulated campaigns behind the p-values, so that a run can be repeated.
    set_aside : collection of (int, str)
        Sites (target, direction) whose anomaly has its own diagnosis.
    effects : mapping of str to Effect, optional
        The library by name; None: the built-in one with the user's own.
    progress : callable
        Called with steps done, steps in total, and what is done.

    Returns
    -------
    LoopResult
        Steps with their errors on the hold-out set in um, verdict, what remains, and the models. It prints a summary, and `plot` draws
        the errors.

    Raises
    ------
    LoopError
        If fewer than 10 cycles are there, or a declared effect cannot be computed from these readings.
    RecordError
        If a record has too few blocks for the declared model, or another effect than ``quasi_static`` is declared.
    ReadingsError
        If fewer than three cycles or targets have readings within the frames' time.

    Notes
    -----
    Procedure, assumptions and error rates: docs/method/closed-loop.md, docs/method/records.md.
    """
    if isinstance(measured, Record):
        return close_record(measured, declared, seed=seed, effects=effects, progress=progress)
    readings = measured if isinstance(measured, Readings) else read_fused(measured)
    return close_axis(readings, declared, seed=seed, set_aside=set_aside, effects=effects, progress=progress)
