"""What a check is: a function by which inputs must agree, registered under its own name, the code of the check.

A contradiction of facts ends the run before the long work; a doubt lets it go on and makes its conclusions conditional. What has to be
right, what is endangered, evidence and remedy stand by the same code in ``fusion/report/templates/consistency.j2``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from inspect import signature
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.common import Array
from fusion.results.parts import Figures

if TYPE_CHECKING:
    from fusion.analysis.consistency.series import FieldSeries, Logged, Motion
    from fusion.results.axis import RegistrationPart
    from fusion.results.loop import AxisLoop
    from thermography.inspection import FileWarning
    from thermography.io.frame import FrameReference

#: When a check is made: of what was read before anything is calculated, of all clocks then and again with the fields, of the fields, of the
#: registration, of what was fitted.
Phase = Literal["source", "clocks", "fields", "plan", "loop"]

# The results that hold only if what a check doubts is right; what the other instrument shows holds anyway.
LASER: tuple[Figures, ...] = ("positions", "attribution", "causes")
CAMERA: tuple[Figures, ...] = ("field", "attribution", "causes")
CLOCK: tuple[Figures, ...] = ("attribution", "causes")
LOG: tuple[Figures, ...] = ("causes",)


@dataclass(frozen=True)
class Found:
    """What a check found.

    Attributes
    ----------
    value, limit : in the unit that the evidence names
    passed : whether the inputs agree
    facts : numbers and names of its sentences
    verified : whether a passed check confirms the input; else its figures hold only under the assumption
    contradicts : whether a check that is not passed ends the run
    """

    value: float
    limit: float
    passed: bool
    facts: Mapping[str, Any]
    verified: bool
    contradicts: bool


def judge(
    value: float,
    limit: float,
    *,
    passed: bool | None = None,
    verified: bool = True,
    contradicts: bool = False,
    **facts: Any,
) -> Found:
    """Compare a value with its limit."""
    passed = bool(value <= limit if passed is None else passed)
    return Found(float(value), float(limit), passed, facts, verified or not passed, contradicts)


@dataclass(frozen=True)
class Inputs:
    """What checks take by the names of their parameters; None where a campaign or a phase lacks it.

    Attributes
    ----------
    deviations, linear : readings; the same of a linear axis, where any is known
    plan_extent_mm : of the plan along the axis
    environment, drivers, sensors : logs; the contact sensors where they stand for the camera
    recompensated : whether the readings were compensated with the environment log
    frames, file_warnings : of the camera; what is conspicuous in what they store
    motion : stamps of the frames of a still table, with the motion of the axis
    frame_time, reading_time : on the clock of the laser
    offset_s : what the campaign file states of the camera's clock
    clocks : what was found of every clock, by code
    fields, field : all frames on the plan; their series of coarse cells
    logged, place_stated : the logged material temperature with the camera's, and whether the sensor's place is stated
    sensor_temperature, sensor_x_mm, sensor_y_mm, sensor_u_K : contact sensors on the plan
    registration : its part of results.json
    loop, travel_mm : its part of results.json, and the largest position
    """

    deviations: xr.Dataset | None = None
    linear: xr.Dataset | None = None
    plan_extent_mm: float | None = None
    environment: xr.Dataset | None = None
    environment_file: str | None = None
    drivers: xr.Dataset | None = None
    drivers_file: str | None = None
    sensors: xr.Dataset | None = None
    sensors_file: str | None = None
    recompensated: bool = False
    frames: Sequence[FrameReference] | None = None
    file_warnings: Sequence[FileWarning] | None = None
    motion: Motion | None = None
    frame_time: NDArray[np.datetime64] | None = None
    reading_time: xr.DataArray | None = None
    offset_s: float | None = None
    clocks: Mapping[str, Found] | None = None
    fields: xr.Dataset | None = None
    field: FieldSeries | None = None
    logged: Logged | None = None
    place_stated: bool | None = None
    sensor_temperature: xr.DataArray | None = None
    sensor_x_mm: Array | None = None
    sensor_y_mm: Array | None = None
    sensor_u_K: float | None = None
    registration: RegistrationPart | None = None
    fiducials_file: str | None = None
    loop: AxisLoop | None = None
    travel_mm: float | None = None


@dataclass(frozen=True)
class Rule:
    """A registered check.

    Attributes
    ----------
    code : for programs and for ``[accept] doubts``
    phase : when it is made
    figures : results that hold only if what it doubts is right
    waits : whether it cannot be judged until a doubted clock is right
    find : the function
    """

    code: str
    phase: Phase
    figures: tuple[Figures, ...]
    find: Callable[..., Found | None]
    waits: bool = False

    def make(self, inputs: Inputs) -> Found | None:
        """Make the check; None where an input is lacking, or there is nothing to check."""
        parameters = signature(self.find).parameters
        given = {name: getattr(inputs, name) for name in parameters}
        lacking = any(value is None and parameters[name].default is not None for name, value in given.items())
        return None if lacking else self.find(**given)


def check(
    phase: Phase, figures: tuple[Figures, ...], *, waits: bool = False
) -> Callable[[Callable[..., Found | None]], Rule]:
    """Register a function as a check; its docstring is the row of ``docs/method/consistency.md``."""
    known = {field.name for field in fields(Inputs)}

    def registered(find: Callable[..., Found | None]) -> Rule:
        if unknown := signature(find).parameters.keys() - known:
            raise TypeError(f"the check {find.__name__} takes {', '.join(sorted(unknown))}: no such input")
        return Rule(find.__name__, phase, figures, find, waits)

    return registered
