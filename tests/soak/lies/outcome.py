"""What an answer is worth: held against the truth of the twin, and searched for words that name the fault."""

from __future__ import annotations

import re
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path

import numpy as np
import xarray as xr

from fusion.results.axis import AnomalyPart
from fusion.results.loop import AxisLoop
from fusion.results.results import Results
from fusion.twin.simulate import Truth
from tests.soak.lies.campaigns import EXPANSION_PPM_PER_K
from tests.soak.lies.lie import Lie

#: Largest error in standard uncertainties, and largest relative error of the expansion coefficient.
_SIGMAS, _RELATIVE = 3.0, 0.1
#: Checks that list many possible faults as their remedy: only what their evidence says names a fault.
_CATCH_ALL = {"expansion_coefficient"}
#: Figures that each check which confirms nothing is printed with.
_NOT_VERIFIED = {
    "material_rise": ("expansion", "table offset", "temperature"),
    "camera_zero": ("expansion", "table offset", "temperature"),
    "camera_picture": ("expansion", "table offset", "temperature"),
    "axis_line": ("expansion",),
}


class Outcome(StrEnum):
    """What a run on a lying input led to."""

    RIGHT = "right"
    CORRECTED = "corrected"
    DOUBTED_NAMED = "doubted, naming the fault"
    DOUBTED = "doubted, not naming it"
    REFUSED_NAMED = "refused, naming the fault"
    REFUSED = "refused, not naming it"
    CONDITIONAL = "wrong in a figure that is printed as not verified"
    SILENTLY_WRONG = "silently wrong"
    TRACEBACK = "traceback"


def refusal(lie: Lie, message: str) -> Outcome:
    """The outcome of a run that was refused."""
    return Outcome.REFUSED_NAMED if _names(lie, message) else Outcome.REFUSED


def judge(lie: Lie, truth: Truth, results: Results, folder: Path) -> tuple[Outcome, list[str]]:
    """The outcome of a run that gave results, and what is wrong in them."""
    wrong = list(_faults(lie, truth, results, folder))
    if results.inputs is not None and results.inputs.state == "doubted":
        named = any(_names(lie, words) for words in _doubts(results))
        return (Outcome.DOUBTED_NAMED if named else Outcome.DOUBTED), wrong
    if wrong:
        open_codes = {check.code for check in results.inputs.unverified} if results.inputs is not None else set()
        covered = tuple({word for code in open_codes for word in _NOT_VERIFIED[code]})
        told = bool(covered) and all(fault.startswith(covered) for fault in wrong)
        return (Outcome.CONDITIONAL if told else Outcome.SILENTLY_WRONG), wrong
    notices = [f"{notice.code}: {notice.message}" for notice in results.warnings]
    return (Outcome.CORRECTED if any(_names(lie, notice) for notice in notices) else Outcome.RIGHT), wrong


def shares_within(truth: Truth, results: Results, folder: Path) -> dict[str, float]:
    """Share of the values of each figure whose error is at most twice its printed standard uncertainty."""
    shares = {}
    loop = results.loop
    if isinstance(loop, AxisLoop):
        true_values = {"axis_expansion": EXPANSION_PPM_PER_K, "table_offset": truth.recipe.drift.offset_um_per_K}
        for entry in loop.declared_coefficients:
            if entry.effect in true_values and entry.value is not None and entry.u is not None:
                shares[entry.effect] = float(abs(entry.value - true_values[entry.effect]) <= 2.0 * entry.u)
        drift = results.drift
        assert drift is not None
        estimate, u = (
            np.array([part.positive, part.negative], dtype=float) for part in (drift.profile_um, drift.profile_u_um)
        )
        true = truth.readings["mean_profile"].values
        if estimate.shape == true.shape:
            shares["profile"] = _share(_line_left_out(estimate - true), u)
    for name, error, u in _field_errors(truth, folder / "fields.nc", 0):
        shares[name] = _share(error, u)
    return shares


def _share(error: np.ndarray, u: np.ndarray) -> float:
    known = np.isfinite(error) & (u > 0.0)
    return float(np.mean(np.abs(error[known]) <= 2.0 * u[known])) if known.any() else float("nan")


def _names(lie: Lie, words: str) -> bool:
    return re.search(lie.family, words, flags=re.IGNORECASE | re.DOTALL) is not None


def _doubts(results: Results) -> Iterator[str]:
    """The words of every doubt."""
    for check in results.inputs.doubts if results.inputs is not None else ():
        yield f"{check.code}: {check.evidence}" + ("" if check.code in _CATCH_ALL else f" {check.remedy}")


def _faults(lie: Lie, truth: Truth, results: Results, folder: Path) -> Iterator[str]:
    """What is wrong in the results."""
    loop = results.loop
    # Readings without scatter have no drift, and no cause is named.
    if isinstance(loop, AxisLoop):
        yield from _wrong_causes(lie, truth, loop)
        yield from _wrong_coefficients(truth, loop)
        yield from _wrong_anomalies(lie, truth, results.anomalies or ())
        yield from _wrong_profile(truth, results)
    yield from _wrong_field(lie, truth, folder / "fields.nc")


def _wrong_causes(lie: Lie, truth: Truth, loop: AxisLoop) -> Iterator[str]:
    """Names that are false, and a verdict that nothing is missing although something is."""
    named = [(step.effect, set(step.tied)) for step in loop.steps if not step.withheld]
    named += [(error.effect, set()) for error in loop.field_corrections]
    missing = {effect.name for effect in truth.recipe.effect}
    untold = missing - {name for name, _ in named}
    for name, tied in named:
        if name in missing | lie.describes:
            continue
        # Of effects that the data cannot tell apart, one name stands for the others; each missing effect is told once.
        if tied & untold:
            untold -= {sorted(tied & untold)[0]}
        else:
            yield f"false cause {name}"
    if untold and loop.verdict in ("complete", "explained"):
        yield f"{loop.verdict} without {', '.join(sorted(untold))}"


def _wrong_coefficients(truth: Truth, loop: AxisLoop) -> Iterator[str]:
    true_values = {
        "axis_expansion": ("expansion", EXPANSION_PPM_PER_K),
        "table_offset": ("table offset", truth.recipe.drift.offset_um_per_K),
    }
    for entry in loop.declared_coefficients:
        if entry.effect in true_values:
            name, true = true_values[entry.effect]
            assert entry.value is not None and entry.u is not None
            if abs(entry.value - true) > max(_RELATIVE * abs(true), _SIGMAS * entry.u):
                yield f"{name} {entry.value:.3g} ± {entry.u:.2g} {entry.unit} (true {true:g})"


def _wrong_anomalies(lie: Lie, truth: Truth, anomalies: tuple[AnomalyPart, ...]) -> Iterator[str]:
    planted = {anomaly.target: anomaly.kind for anomaly in truth.recipe.anomaly}
    for anomaly in anomalies:
        right = {"undetermined", planted.get(anomaly.target, ""), *lie.describes}
        if anomaly.target not in {*planted, *lie.targets}:
            yield f"false anomaly at target {anomaly.target} ({anomaly.cause})"
        elif anomaly.cause not in right:
            yield f"cause {anomaly.cause} at target {anomaly.target}"
    yield from (f"no anomaly at target {target}" for target in sorted(planted.keys() - {a.target for a in anomalies}))


def _wrong_profile(truth: Truth, results: Results) -> Iterator[str]:
    """The profile less its straight line, which depends on the cycles that the mean is taken over."""
    drift = results.drift
    assert drift is not None
    estimate, u = (
        np.array([part.positive, part.negative], dtype=float) for part in (drift.profile_um, drift.profile_u_um)
    )
    true = truth.readings["mean_profile"].values
    if estimate.shape != true.shape:
        # A target without readings has no place in the results.
        return
    error = _line_left_out(estimate - true)
    ratio = _rms(error) / _rms(u)
    if not ratio <= _SIGMAS:
        yield f"profile off by {_rms(error):.3g} µm (u {_rms(u):.2g} µm)"


def _line_left_out(error: np.ndarray) -> np.ndarray:
    """Errors (direction, target) less the straight line through all of them; NaN in a direction without readings."""
    target = np.broadcast_to(np.arange(error.shape[1], dtype=float), error.shape)
    known = np.isfinite(error)
    if np.count_nonzero(known) < 3:
        return error
    return error - np.polyval(np.polyfit(target[known], error[known], 1), target)


def _wrong_field(lie: Lie, truth: Truth, path: Path) -> Iterator[str]:
    """Temperature and rise of every cell on the table and every cycle against the true field."""
    for name, error, u in _field_errors(truth, path, lie.renumbered):
        # The rise of the reference cycle is zero by definition, with no uncertainty.
        known = np.isfinite(error) & (u > 0.0)
        if not known.any() or not _rms(error[known]) <= _SIGMAS * _rms(u[known]):
            yield f"{name} off by {_rms(error[known]):.3g} K (u {_rms(u[known]):.2g} K)"


def _field_errors(truth: Truth, path: Path, renumbered: int) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Name, error and standard uncertainty of temperature and rise, of every cell on the table and every cycle."""
    plan = truth.recipe.plan
    with xr.open_dataset(path, engine="h5netcdf") as whole:
        fields = whole.sel(x=slice(0.0, plan.width_mm), y=slice(0.0, plan.height_mm))
        true = truth.temperature(truth.session.frame_s, fields["x"].values, fields["y"].values, cell_mm=10.0)
        rows = fields["cycle"].values + renumbered - 1
        # A cycle entered twice, as one more at the end, was measured in no time of its own.
        rows = np.minimum(rows, len(true) - 1)
        for name, expected in (("temperature", true[rows]), ("temperature_rise", true[rows] - true[rows[0]])):
            yield name, fields[name].values - expected, fields[f"{name}_u"].values


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(values, dtype=float)))) if np.isfinite(values).any() else float("nan")
