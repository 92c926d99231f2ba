"""Correction of the fields: errors of the camera that the loop found are taken out of the fields, and all is computed again.

A step of the camera's zero is uniform from one frame on; a reflection is a patch that switches. Both were found as what they do to the
prediction of the drift; here they become what is to be added to every cell of every frame. The field itself shows their size far more
sharply than the drift does, so its size is taken where both agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.alignment.align import cycle_bounds
from fusion.alignment.reflection_patch import find_switching_patch
from fusion.effects.camera import CAMERA_OFFSET, REFLECTED_SOURCE
from fusion.loop.result import LoopResult
from thermography.fields.tasks.pieces import in_pieces, piece_slices
from thermography.fields.tasks.spool import empty_array, give_back

#: Standard uncertainties within which the sizes from the drift and from the field agree.
_AGREEMENT = 3.0


@dataclass(frozen=True)
class FieldFault:
    """One error of the camera, as the loop found it.

    Attributes
    ----------
    effect : ``camera_offset`` or ``reflected_source``
    text : what was wrong, in one sentence
    size_K, size_u_K : largest size of the error and its standard uncertainty
    first_cycle : the first cycle whose field it touches
    course_K : (time,) K, what is to be added to every frame where the pattern is 1
    pattern : (y, x) where it is to be added, and which share of it
    """

    effect: str
    text: str
    size_K: float
    size_u_K: float
    first_cycle: int
    course_K: Array
    pattern: Array

    def as_json(self) -> dict[str, float | int | str]:
        """The entry of ``loop.field_corrections`` in results.json."""
        return {
            "effect": self.effect,
            "text": self.text,
            "size_K": self.size_K,
            "size_u_K": self.size_u_K,
            "first_cycle": self.first_cycle,
        }


def find_field_errors(result: LoopResult, fields: xr.Dataset, fused: xr.Dataset) -> list[FieldFault]:
    """Return every error of the camera that entered the model, with the correction of the frames.

    Parameters
    ----------
    result : of the loop on these fields
    fields : keeps ``thermography.contract.FIELDS``
    fused : both recordings on one clock, from these fields
    """
    errors = []
    time = fields["time"].values.astype("datetime64[ns]")
    start = _start(fused)
    frame_cycle = _cycle_of(time, fused)
    for step in result.steps:
        if step.effect not in (CAMERA_OFFSET.name, REFLECTED_SOURCE.name):
            continue
        size, u = float(step.coefficients[0]["value"]), float(step.coefficients[0]["u"])
        if step.effect == CAMERA_OFFSET.name:
            size = _agreed(size, u, float(step.parameters["jump_of_the_field_K"]))
            # A microsecond of slack: the instant went through seconds in floating point.
            late = (time - start) / np.timedelta64(1, "s") >= float(step.parameters["time_s"]) - 1e-6
            error, pattern = size * late, np.ones(fields["frame_temperature"].shape[1:])
            text = f"the camera read {size:+.3f} ± {2.0 * u:.3f} K (k = 2) too high"
        else:
            patch = find_switching_patch(fields["frame_temperature"])
            if patch is None:
                continue
            # A warm body adds to what the camera sees: the lowest state is the one without it.
            course = patch.course - patch.course.min()
            size = _agreed(size, u, 1.0)
            error, pattern = size * course, patch.pattern
            height = float(course.max())
            text = f"a reflected source added up to {size * height:.2f} ± {2.0 * u * height:.2f} K (k = 2) over a patch"
            size, u = size * height, u * height
        touched = np.flatnonzero(error)
        first = int(frame_cycle[touched[0]]) if touched.size else int(frame_cycle[-1])
        errors.append(
            FieldFault(step.effect, f"{text} from cycle {first} on", size, u, first, -np.asarray(error, float), pattern)
        )
    return errors


def _agreed(fitted: float, u: float, seen: float) -> float:
    """The size that the field shows, or that fitted to the drift where both disagree."""
    return seen if abs(seen - fitted) <= _AGREEMENT * u else fitted


def correct_fields(fields: xr.Dataset, errors: list[FieldFault]) -> xr.Dataset:
    """Take the camera's errors out of every frame.

    Parameters
    ----------
    fields : keeps ``thermography.contract.FIELDS``
    errors : of :func:`find_field_errors`

    Returns
    -------
    Dataset
        The same fields with ``frame_temperature`` corrected, degC; the input is unchanged.
    """
    if not errors:
        return fields
    frames = fields["frame_temperature"]
    corrected = empty_array(frames.shape, float)
    for some, values in in_pieces(frames):
        corrected[some] = values + _correction(errors, some)
        give_back(corrected)
    return fields.assign(frame_temperature=frames.copy(data=corrected))


def _correction(errors: Sequence[FieldFault], frames: slice | NDArray[np.bool_]) -> Array:
    """What is to be added to some frames, (some, y, x) K."""
    return np.asarray(np.sum([one.course_K[frames, None, None] * one.pattern for one in errors], axis=0))


def corrected_variables(fields: xr.Dataset, fused: xr.Dataset, errors: list[FieldFault]) -> dict[str, xr.Variable]:
    """Corrected fields per cycle and the correction of every frame, for fusion.nc.

    Parameters
    ----------
    fields : keeps ``thermography.contract.FIELDS``
    fused : both recordings on one clock
    errors : of :func:`find_field_errors`

    Returns
    -------
    dict of Variable
        The correction of every frame in K (time, y, x), temperature in degC and its rise in K per cycle (cycle, y, x).
    """
    frames, cycles = fields["frame_temperature"], fields["temperature"]
    total, temperature, rise = (empty_array(one.shape, np.float32) for one in (frames, cycles, cycles))
    for some in piece_slices(frames.shape):
        total[some] = _correction(errors, some)
        give_back(total)
    of_cycle = _of_cycles(fields, fused, errors)
    start = of_cycle(fields["cycle"].values[0])
    for (some, mean), (_, risen) in zip(in_pieces(cycles), in_pieces(fields["temperature_rise"]), strict=True):
        added = np.stack([of_cycle(cycle) for cycle in fields["cycle"].values[some]])
        temperature[some], rise[some] = mean + added, risen + added - start
        give_back(temperature, rise)
    plan = ("plan_y", "plan_x")
    kelvin = {"units": "K", "units_metadata": "temperature: difference"}
    why = "; ".join(one.text for one in errors)
    return {
        "field_correction": xr.Variable(
            ("frame_time", *plan),
            total,
            {**kelvin, "long_name": "to be added to frame_temperature of fields.nc", "comment": why},
        ),
        "temperature_corrected": xr.Variable(
            ("cycle", *plan),
            temperature,
            {"units": "degC", "units_metadata": "temperature: on_scale", "comment": why},
        ),
        "temperature_rise_corrected": xr.Variable(("cycle", *plan), rise, {**kelvin, "comment": why}),
    }


def _of_cycles(fields: xr.Dataset, fused: xr.Dataset, errors: Sequence[FieldFault]) -> Callable[[int], Array]:
    """Return what gives the mean correction of a cycle's frames, (y, x) K; of one without frames that of the frame before."""
    frame_cycle = _cycle_of(fields["time"].values.astype("datetime64[ns]"), fused)

    def of_cycle(cycle: int) -> Array:
        own = frame_cycle == cycle
        if not own.any():
            own[np.flatnonzero(frame_cycle < cycle)[-1:]] = True
        return np.asarray(_correction(errors, own).mean(axis=0)) if own.any() else np.zeros(errors[0].pattern.shape)

    return of_cycle


def _start(fused: xr.Dataset) -> np.datetime64:
    """Time of the first reading, from which the loop counts its seconds."""
    time = fused["time"].values.astype("datetime64[ns]")
    present = np.isfinite(fused["deviation"].values) & ~np.isnat(time)
    return np.datetime64(time[present].min())


def _cycle_of(frame_time: Array, fused: xr.Dataset) -> Array:
    """Cycle of every frame; those outside all cycles count to the nearest before, or to the first."""
    bounds = cycle_bounds(fused)
    place = np.clip(np.searchsorted(bounds[:, 0], frame_time, side="right") - 1, 0, None)
    return np.asarray(fused["cycle"].values[place])
