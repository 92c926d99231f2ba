"""A drift model as a control runs it: a discrete-time recursion of first-order states, with everything that it may not exceed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from fusion.common import Array, FusionError
from fusion.results.parts import ResultPart
from fusion.results.store import read_json

#: What a step found: all readings within their range; one held at the end of its range, or a correction at its limit; a failed reading; the
#: state of the machine is not known (yet); steps come at other times than the model was made for. From `FAILED` on nothing is corrected.
OK, SATURATED, FAILED, UNKNOWN, UNTIMELY = range(5)
#: Time constants after which a state that was not known at the start is known to 5 %.
_SETTLED = 3.0
#: Memory (share from step to step) and limit (steps) of how late steps are: a period that is another one by a tenth.
LATE_KEPT, LATE_STEPS = 0.99, 10.0


class RecursionError(FusionError):
    """A model description that cannot be read or run; the message names the file and what is wrong."""


class RecursionInput(ResultPart):
    """A reading that the control supplies in every step."""

    name: str
    """Name of the sensor or driver."""
    unit: str
    """Unit of the reading."""
    reference: float
    """Reading at which it contributes nothing."""
    low: float
    """Lowest reading that is followed, half the range of the test below it; a lower one is held here."""
    high: float
    """Highest reading that is followed; a higher one is held here."""
    failed_below: float
    """A reading below this value, or one that is no number, is that of a failed sensor."""
    failed_above: float
    """The same for a reading above."""


class RecursionState(ResultPart):
    """A first-order state: ``x = decay x + now v + before v'`` with the signal v of this step and v' of the step before."""

    input: int
    """Place of its input, from 0."""
    size: float
    """The signal is the reading less its reference, over this size."""
    exponent: Literal[1, 2]
    """Power to which the signal is raised."""
    time_constant_s: float
    """Time constant, s; 0: the signal itself."""
    decay: float
    """Weight of the state before."""
    now: float
    """Weight of the signal of this step."""
    before: float
    """Weight of the signal of the step before."""
    start: float
    """Share of the first signal that the state starts with: 0 of a load that starts with the machine, 1 of what was there before."""


class RecursionOutput(ResultPart):
    """A correction: minus the sum of coefficients times states, to be added to the commanded value."""

    name: str
    """Name of the displacement that it corrects."""
    unit: Literal["um", "um/m"]
    """Unit of the correction."""
    coefficients: tuple[float, ...]
    """Predicted displacement per state."""
    limit: float
    """Largest correction, half as much again as its range in the test; a larger one is held here."""
    max_step: float
    """Largest change of the correction in one step."""
    before: float
    """Root mean square displacement of the hold-out set from the last value before it, without a correction."""
    u: float
    """Standard uncertainty of the correction over the hours after a zero that a remark names: of a single run the root mean square error of
    predicting what the coefficients were not fitted to, of several the one that is expected."""


class SensorCurvePoint(ResultPart):
    """The error that a number of sensors leaves."""

    sensors: tuple[str, ...]
    """The sensors."""
    cross_rmse: float
    """Error of the parts of the training time, each predicted from the others; mean over the channels, um."""
    held_out_rmse: float
    """Error on the hold-out set, which decides nothing; mean over the channels, um."""


class Recursion(ResultPart):
    """A drift model as a discrete-time recursion."""

    format: Literal["thermofuse recursion 2"] = "thermofuse recursion 2"
    """Version of this layout."""
    campaign: str
    """Title of the campaign that it was made from."""
    results_sha256: str
    """SHA-256 of its results.json."""
    held_out: str
    """What the uncertainties were judged on."""
    sampling_s: float
    """Time from one step to the next, s."""
    inputs: tuple[RecursionInput, ...]
    """Readings, in the order in which they are passed."""
    states: tuple[RecursionState, ...]
    """States."""
    outputs: tuple[RecursionOutput, ...]
    """Corrections."""
    sensor_curve: tuple[SensorCurvePoint, ...] = ()
    """Error over the number of sensors; of a reduced model only."""
    remarks: tuple[str, ...] = ()
    """What to know of it, one sentence each."""

    @property
    def settling_steps(self) -> int:
        """Steps after which states that nobody knew at the start are known."""
        return round(_SETTLED * max((one.time_constant_s for one in self.states), default=0.0) / self.sampling_s)

    @property
    def loads(self) -> tuple[bool, ...]:
        """Which states follow a driver, which is off while the control is; a temperature goes on meanwhile."""
        return tuple(self.inputs[one.input].unit != "degC" for one in self.states)

    def at_sampling(self, sampling_s: float) -> Recursion:
        """The same model with another time from step to step."""
        outputs = [
            one.model_copy(update={"max_step": one.max_step * sampling_s / self.sampling_s}) for one in self.outputs
        ]
        states = [
            one.model_copy(
                update=dict(zip(_WEIGHTS, first_order_weights(one.time_constant_s, sampling_s), strict=True))
            )
            for one in self.states
        ]
        return self.model_copy(update={"sampling_s": sampling_s, "states": tuple(states), "outputs": tuple(outputs)})


_WEIGHTS = ("decay", "now", "before")


def first_order_weights(time_constant_s: float, sampling_s: float) -> tuple[float, float, float]:
    """Weights of the state before, of the signal now and of the signal before: exact for a signal that is linear between two steps."""
    if time_constant_s <= 0.0:
        return 0.0, 1.0, 0.0
    decay = float(np.exp(-sampling_s / time_constant_s))
    ramp = float(-np.expm1(-sampling_s / time_constant_s)) * time_constant_s / sampling_s
    return decay, 1.0 - ramp, ramp - decay


@dataclass(frozen=True)
class Corrections:
    """What a recursion gives.

    Attributes
    ----------
    correction : (steps, outputs), in the unit of each output
    status : (steps,), `OK`, `SATURATED`, `FAILED`, `UNKNOWN` or `UNTIMELY`
    kept : what a restart needs; None where it never started
    """

    correction: Array
    status: NDArray[np.int64]
    kept: Kept | None = None


@dataclass(frozen=True)
class Kept:
    """What survives a restart: signals and states (states,), the datum (outputs,), and steps until states that nobody knew are known."""

    signal: Array
    state: Array
    zeroed: Array
    resting: int


def run_recursion(
    model: Recursion,
    readings: Array,
    *,
    zero: NDArray[np.bool_] | None = None,
    reset: NDArray[np.bool_] | None = None,
    elapsed_s: Array | None = None,
    cold: bool = True,
    kept: Kept | None = None,
    off_s: float = 0.0,
) -> Corrections:
    """Run a recursion over readings (steps, inputs), as the emitted programs do, operation by operation.

    Parameters
    ----------
    model : Recursion
        The model.
    readings : (steps, inputs) ndarray
        One row per step of `sampling_s`; NaN for a reading that is missing.
    zero : (steps,) ndarray of bool, optional
        Steps that take the present state of the machine as the one without a correction.
    reset : (steps,) ndarray of bool, optional
        Steps that end the rest after a failed reading.
    elapsed_s : (steps,) ndarray, optional
        Time since the step before, as the control measures it. None: `sampling_s`.
    cold : bool
        Whether the machine has rested so long before the start that it is cold.
    kept : Kept, optional
        What was kept of the run before, which replaces `cold`.
    off_s : float
        Time since its last step, in which drivers rested and temperatures went straight to the first reading.

    Returns
    -------
    Corrections
        Nothing starts before all readings are there. A reading outside its range is held at the end of it. After a failed reading the
        corrections go to zero, within one minute from their limit, and stay there until a reset. A machine that is neither cold nor known
        is not corrected for three of the longest time constants; what is left then is taken as the state without a correction.
    """
    columns = {name: np.array([getattr(one, name) for one in model.inputs]) for name in RecursionInput.model_fields}
    readings = np.asarray(readings, float)
    if readings.ndim != 2 or readings.shape[1] != len(model.inputs):
        raise RecursionError(f"readings of shape {readings.shape}; the model takes (steps, {len(model.inputs)})")
    of = np.array([one.input for one in model.states])
    size, exponent, decay, now, before, start = (
        np.array([getattr(one, name) for one in model.states]) for name in ("size", "exponent", *_WEIGHTS, "start")
    )
    coefficients = np.array([one.coefficients for one in model.outputs])
    limit, most = (np.array([getattr(one, name) for one in model.outputs]) for name in ("limit", "max_step"))
    elapsed = np.full(len(readings), model.sampling_s) if elapsed_s is None else elapsed_s
    held, signal, state = columns["reference"].copy(), np.zeros(of.size), np.zeros(of.size)
    zeroed, out = np.zeros(limit.size), np.zeros(limit.size)
    resting = 0 if cold else model.settling_steps
    if kept is not None:
        steps = max(1, int(off_s / model.sampling_s))
        signal, state, zeroed, resting = kept.signal, kept.state, kept.zeroed, max(0, kept.resting - steps)
        over = [first_order_weights(one.time_constant_s, steps * model.sampling_s) for one in model.states]
        off, risen, fallen = (
            np.where(np.array(model.loads) & (decay > 0.0), [[1.0], [0.0], [0.0]], 1.0) * np.array(over).T
        )
    latched, started, late = False, False, 0.0
    correction, status = np.zeros((len(readings), limit.size)), np.full(len(readings), UNKNOWN, np.int64)
    for step, row in enumerate(readings):
        good = (row >= columns["failed_below"]) & (row <= columns["failed_above"])
        if not started and not good.all():
            continue
        held = np.where(good, np.clip(row, columns["low"], columns["high"]), held)
        latched = not good.all() or (latched and not (reset is not None and reset[step]))
        last = signal
        signal = (held[of] - columns["reference"][of]) / size
        signal = np.where(exponent == 2, signal * signal, signal)
        if started:
            state = decay * state + now * signal + before * last
            late = LATE_KEPT * late + (elapsed[step] - model.sampling_s)
        else:
            state = start * signal if kept is None else off * state + risen * signal + fallen * last
        started = True
        untimely = abs(late) > LATE_STEPS * model.sampling_s
        wanted = -(coefficients @ state)
        if resting > 0 or (zero is not None and zero[step]):
            zeroed = wanted
        wanted = wanted - zeroed
        idle = latched or untimely or resting > 0
        bounded = np.zeros(limit.size) if idle else np.clip(wanted, -limit, limit)
        out = out + np.clip(bounded - out, -most, most)
        saturated = (good & (held != row)).any() or (not idle and bool((bounded != wanted).any()))
        found = SATURATED if saturated else OK
        status[step] = FAILED if latched else UNTIMELY if untimely else UNKNOWN if resting > 0 else found
        resting = max(0, resting - 1)
        correction[step] = out
    return Corrections(correction, status, Kept(signal, state, zeroed, resting) if started else None)


def read_recursion(path: str | Path) -> Recursion:
    """Read a model description that `export --format model-json` wrote; a RecursionError where the file is none."""
    try:
        return Recursion.model_validate(read_json(Path(path)))
    except (OSError, ValueError, ValidationError) as error:
        told = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise RecursionError(
            f"{path}: no model description of thermofuse ({told}); write one with --format model-json"
        ) from None
