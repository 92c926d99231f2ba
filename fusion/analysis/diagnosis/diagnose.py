"""Diagnosis of anomalous targets: the cause with its probability, the evidence for and against it, and what to check on the machine.

Explanations compete by likelihood: scatter (structural), scatter or a random walk that depends on the direction of approach (stick-slip),
local temperature through a first-order lag, a step, and a random walk that none of these explains. A cause is named only if its
probability exceeds a threshold set on simulated campaigns, its own test rejects the null hypothesis, and the fit to one direction predicts
the other; otherwise the cause is "undetermined", because a false cause costs more than none. Method: docs/method/diagnosis.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import xarray as xr
from scipy import special

from fusion.analysis.alignment.readings import check_readings, known_mean
from fusion.analysis.diagnosis.causes import CAUSES, say, undetermined_check
from fusion.analysis.diagnosis.explanations import (
    LAGS_S,
    DiagnosisError,
    ProfileFit,
    RandomWalkFit,
    Residual,
    ScatterFit,
    fit_profile,
    fit_random_walk,
    fit_scatter,
    lagged_temperature,
    local_residuals,
    serial_p_value,
    step_columns,
    step_instant,
    warm_up_share,
)
from fusion.analysis.levels import CAUSE_LEVELS, LINK_COURSE_LEVEL, SERIAL_LEVEL
from fusion.results.axis import Cause
from interferometry.common import Array, one_thread
from interferometry.links import fit_jumps

#: Minimum probability of each cause, set and checked on simulated campaigns by tests/soak/test_diagnosis_rates.py.
THRESHOLDS: dict[str, float] = {
    "structural": 0.3,
    "local_temperature": 0.8,
    "stick_slip": 0.4,
    "step": 0.6,
    "link": 0.95,
}
#: Log-likelihood (nats) that an explanation by the direction of approach must gain over scatter equal in both directions: amounts along
#: the motion, more scatter in one direction, a random walk in one direction (beside its parameter). Scatter equal in both directions
#: exceeds one of them by chance in about one case of twenty.
APPROACH_NATS = {"along": 2.1, "one_direction": 4.0, "slow": 2.0}
#: A local temperature that follows one warm-up to at least this share of its variance is collinear with every other slow cause.
WARM_UP_SHARE = 0.98


class Flagged(Protocol):
    """What a diagnosis needs of an anomaly; :class:`interferometry.anomalies.Anomaly` provides it."""

    @property
    def target(self) -> int:
        """Target number, from 1."""

    @property
    def direction(self) -> str:
        """Affected direction: ``"positive"``, ``"negative"`` or ``"both"``."""


@dataclass(frozen=True)
class Diagnosis:
    """Cause of one anomaly.

    Attributes
    ----------
    target : target number, from 1
    direction : affected direction: "positive", "negative" or "both"
    cause : name of the cause, "undetermined" where the data do not decide
    probability : of that cause among the explanations tried; for "undetermined", that of the best explanation
    evidence : numbers by name; the name states the unit (um, um_per_K, s, nats), or that it is a probability
    for_it, against_it : sentences with numbers for the leading explanation, and against it
    check : what to check on the machine
    """

    target: int
    direction: str
    cause: Cause
    probability: float
    evidence: dict[str, Any]
    for_it: tuple[str, ...]
    against_it: tuple[str, ...]
    check: str

    def __str__(self) -> str:
        """Return the cause in one line, and what to check."""
        return (
            f"target {self.target}, {self.direction}: {self.cause} (probability {self.probability:.2f}). {self.check}"
        )


@dataclass(frozen=True)
class _Case:
    """All fits of one target."""

    residual: Residual
    random_walk: RandomWalkFit
    scatter: ScatterFit
    temperature: ProfileFit | None
    step: ProfileFit
    serial_p: float
    warm_up_share: float

    @property
    def tested(self) -> dict[str, ProfileFit]:
        """The explanations with a bootstrap test of their own, by name."""
        return {"step": self.step} | ({"local_temperature": self.temperature} if self.temperature is not None else {})

    @property
    def excluded(self) -> list[str]:
        """The explanations that their own tests exclude: as much of them is no rarity in an ordinary slow drift."""
        return [name for name, fit in self.tested.items() if fit.p_value > CAUSE_LEVELS[name]]

    @property
    def step_cycle(self) -> int:
        """Number of the first cycle after the best step."""
        return int(self.residual.cycle[step_instant(self.step.best)])

    @property
    def approach_gain(self) -> float:
        """Log-likelihood gained by scatter that depends on the direction of approach over scatter equal in both directions, nats."""
        return max(self.scatter.one_direction, self.scatter.along_approach) - self.scatter.both


@one_thread
def diagnose(fused: xr.Dataset, anomalies: Sequence[Flagged], *, seed: int = 0) -> list[Diagnosis]:
    """Diagnose the cause of every anomaly.

    Parameters
    ----------
    fused : xarray.Dataset
        From :func:`fusion.analysis.alignment.align.align`: `deviation`, um, and `time` (cycle, direction, target); `position` (target,),
        mm; and, where the camera sees the targets, `local_rise_series` (frame_time, target), K.
    anomalies : sequence of Flagged
        Anomalous targets with their direction, as from :func:`interferometry.anomalies.detect_anomalies`; all of them are left out of the
        estimate of the drift.
    seed : int
        Seed of the bootstrap; each target has its own random numbers.

    Returns
    -------
    list of Diagnosis
        One per anomaly, in the same order.

    Raises
    ------
    DiagnosisError
        A target is unknown or was read in fewer than 12 cycles, or fewer than 3 targets are free of anomalies.

    Notes
    -----
    Explanations are compared by the Bayesian information criterion with equal prior probabilities (Schwarz 1978, Ann. Stat. 6, 461; Kass
    and Raftery 1995, J. Am. Stat. Assoc. 90, 773); docs/method/diagnosis.md.

    Examples
    --------
    Target 3 shifts by 1 um after 20 of 40 cycles, beside 0.1 um of noise:

    >>> from types import SimpleNamespace
    >>> rng = np.random.default_rng(1)
    >>> deviation = 0.1 * rng.standard_normal((40, 2, 6))
    >>> deviation[20:, :, 2] += 1.0
    >>> time = np.datetime64("2026-03-09", "ns") + np.arange(480) * np.timedelta64(10, "s")
    >>> dims = ("cycle", "direction", "target")
    >>> fused = xr.Dataset(
    ...     {"deviation": (dims, deviation), "time": (dims, time.reshape(40, 2, 6)), "position": ("target", 20.0 * np.arange(6))},
    ...     coords={"cycle": np.arange(1, 41), "direction": ["positive", "negative"], "target": np.arange(1, 7)},
    ... )
    >>> (diagnosis,) = diagnose(fused, [SimpleNamespace(target=3, direction="both")])
    >>> diagnosis.cause, diagnosis.evidence["step_cycle"]
    ('step', 21)
    """
    fused = check_readings(fused, "fused", "align", DiagnosisError)
    flagged = {int(anomaly.target) for anomaly in anomalies}
    cases = {target: _fit_explanations(fused, target, flagged, seed) for target in sorted(flagged)}
    return [_judge(cases[int(anomaly.target)], str(anomaly.direction)) for anomaly in anomalies]


def diagnose_link(fused: xr.Dataset, link: Flagged) -> Diagnosis:
    """Diagnose a jump between a target and the one before: against scatter of either, and by its course in time."""
    targets = fused["target"].values
    jumps = fit_jumps(fused, int(np.flatnonzero(targets == link.target)[0]), link.direction)
    before = int(targets[jumps.before])
    probability = float(special.expit(jumps.gain_nats))
    against = []
    if probability < THRESHOLDS["link"]:
        against.append(say("link_or_scatter", before=before, target=link.target, probability=1.0 - probability))
    if jumps.serial_p < LINK_COURSE_LEVEL:
        against.append(say("link_has_a_course", p=jumps.serial_p))
    cause: Cause = "undetermined" if against else "link"
    own, other = ratios = link_ratios(fused, link.target, link.direction)
    beyond = "" if other is None else say("link_behind", other=other)
    size = {"size": jumps.size_um, "expanded_u": 2.0 * jumps.size_u_um}
    return Diagnosis(
        target=link.target,
        direction=link.direction,
        cause=cause,
        probability=probability,
        evidence={
            "probability_link": probability,
            "jump_um": jumps.size_um,
            "jump_u_um": jumps.size_u_um,
            "serial_p": jumps.serial_p,
            **dict(zip(("link_before_ratio", "link_after_ratio"), ratios, strict=True)),
        },
        for_it=(
            say("link_jumps", target=link.target, before=before, **size),
            say("link_gain", nats=jumps.gain_nats),
            say("links", before=before, own=own) + beyond,
        ),
        against_it=tuple(against),
        check=CAUSES[cause].check if cause == "link" else undetermined_check("link"),
    )


def link_ratios(fused: xr.Dataset, target: int, direction: str) -> tuple[float | None, float | None]:
    """Return the standard deviations of the differences to the neighbours before and behind (equation 6) over the median of all links."""
    along = fused.isel(target=np.argsort(fused["position"].values, kind="stable")).transpose(
        "cycle", "direction", "target", ...
    )
    sides = [direction in ("both", str(name)) for name in along["direction"].values]
    differences = np.diff(along["deviation"].values[:, sides], axis=2)
    known = np.isfinite(differences)
    centred = np.where(known, differences - known_mean(differences, axis=0), 0.0)
    scatter = np.sqrt((centred**2).sum(axis=(0, 1)) / np.maximum(known.sum(axis=(0, 1)) - len(centred[0]), 1))
    ratios: Array = scatter / max(float(np.median(scatter)), 1e-12)
    at = int(np.flatnonzero(along["target"].values == target)[0])
    return (float(ratios[at - 1]) if at else None, float(ratios[at]) if at < ratios.size else None)


def _fit_explanations(fused: xr.Dataset, target: int, flagged: set[int], seed: int) -> _Case:
    """Fit every explanation to one target."""
    rng = np.random.default_rng([seed, target])
    residual = local_residuals(fused, target, flagged)
    columns = lagged_temperature(residual)
    temperature = None if columns is None else fit_profile(residual, columns, rng)
    return _Case(
        residual=residual,
        random_walk=fit_random_walk(residual),
        scatter=fit_scatter(residual),
        temperature=temperature,
        step=fit_profile(residual, step_columns(residual.seconds.size), rng),
        serial_p=serial_p_value(residual, rng),
        warm_up_share=0.0 if columns is None else warm_up_share(residual.seconds, columns[:, 0]),
    )


def _probabilities(case: _Case) -> dict[str, float]:
    """Return the probabilities of the causes and of "slow" (a random walk without a cause), equal before the data."""
    cycles = case.residual.seconds.size
    parameter = 0.5 * float(np.log(cycles))
    scatter = case.scatter
    sticking = float(
        np.logaddexp(
            scatter.one_direction - APPROACH_NATS["one_direction"], scatter.along_approach - APPROACH_NATS["along"]
        )
    )
    # The scatter's own likelihoods, of all readings, divide the probability of white noise between both explanations by scatter.
    share = 1.0 / (1.0 + float(np.exp(np.clip(scatter.both - sticking, -50, 50))))
    walk = case.random_walk
    score = {
        "structural": walk.white + float(np.log(max(1.0 - share, 1e-30))),
        "stick_slip": max(
            walk.white + float(np.log(max(share, 1e-30))),
            walk.one_direction - parameter - APPROACH_NATS["slow"],
        ),
        "slow": walk.shared - parameter,
        "step": case.step.log_likelihood - parameter - float(np.log(step_columns(cycles).shape[1])),
    }
    if case.temperature is not None:
        score["local_temperature"] = case.temperature.log_likelihood - parameter - float(np.log(len(LAGS_S)))
    for name in case.excluded:
        score[name] = -np.inf
    highest = max(score.values())
    weight = {name: float(np.exp(value - highest)) for name, value in score.items()}
    total = sum(weight.values())
    return {name: value / total for name, value in weight.items()}


def _judge(case: _Case, direction: str) -> Diagnosis:
    """Name the leading explanation of one target, unless there is an objection to it."""
    probability = _probabilities(case)
    leading = max(probability, key=lambda name: probability[name])
    against = _objections(case, leading, probability[leading])
    cause: Cause = "undetermined" if against or leading == "slow" else leading  # type: ignore[assignment]
    others = [name for name in probability if name != leading and name not in case.excluded]
    runner_up = max(others, key=lambda name: probability[name])
    against.append(say("next_best", name=_in_words(runner_up), probability=probability[runner_up]))
    against += [say("excluded", name=_in_words(name), p=case.tested[name].p_value) for name in case.excluded]
    return Diagnosis(
        target=case.residual.target,
        direction=direction,
        cause=cause,
        probability=probability[leading],
        evidence=_evidence(case, probability),
        for_it=tuple(_support(case, leading)),
        against_it=tuple(against),
        check=undetermined_check(leading) if cause == "undetermined" else CAUSES[cause].check,
    )


def _in_words(explanation: str) -> str:
    """Return the name of an explanation in words; a random walk is no cause."""
    return "random walk" if explanation == "slow" else CAUSES[explanation].words


def _objections(case: _Case, leading: str, probability: float) -> list[str]:
    """Return the reasons against naming the leading explanation as the cause; empty where it is named."""
    reasons = []
    threshold = THRESHOLDS.get(leading, 0.0)
    if probability < threshold:
        reasons.append(say("improbable", probability=probability, name=_in_words(leading), threshold=threshold))
    fit = case.tested.get(leading)
    if fit is not None and fit.hold_out_gain <= 0:
        reasons.append(say("not_predicted", nats=fit.hold_out_gain))
    if leading == "local_temperature" and case.temperature is not None:
        positive, negative = case.temperature.by_direction
        if positive * negative < 0:
            reasons.append(say("signs_differ", positive=positive, negative=negative))
        if case.warm_up_share >= WARM_UP_SHARE:
            reasons.append(say("one_warm_up", share=case.warm_up_share))
    if leading == "slow":
        reasons.append(say("slow", p=case.serial_p))
    return reasons


def _support(case: _Case, leading: str) -> list[str]:
    """Return the sentences in favour of the leading explanation."""
    residual, fit = case.residual, case.tested.get(leading)
    sentences = [say("scatter", scatter=float(np.nanstd(residual.values)), typical=residual.typical_um)]
    if fit is not None:
        size = {"size": fit.coefficient, "expanded_u": 2.0 * fit.coefficient_u, "p": fit.p_value}
        lag = np.nan if case.temperature is None else LAGS_S[case.temperature.best]
        sentences.append(say(leading, cycle=case.step_cycle, lag=lag, nats=fit.hold_out_gain, **size))
    elif leading == "stick_slip":
        sentences += [_directions("both_directions", residual), say("approach", nats=case.approach_gain)]
    elif leading == "structural":
        sentences.append(say("not_serial" if case.serial_p > SERIAL_LEVEL else "serial", p=case.serial_p))
        sentences.append(_directions(_agreement(residual), residual))
    return sentences


def _directions(words: str, residual: Residual) -> str:
    """Return a sentence on the standard deviations of both directions."""
    positive, negative = residual.scatter_um
    return say(words, positive=positive, negative=negative)


def _agreement(residual: Residual) -> str:
    """Return whether the standard deviations of both directions agree within their expanded uncertainty (k = 2)."""
    freedom = np.isfinite(residual.values).sum(axis=1) - 1
    if (freedom < 1).any():
        return "not_compared"
    positive, negative = residual.scatter_um
    u_positive, u_negative = np.array([positive, negative]) / np.sqrt(2.0 * freedom)
    agree = abs(positive - negative) <= 2.0 * np.hypot(u_positive, u_negative)
    return "equal_directions" if agree else "both_directions"


def _evidence(case: _Case, probability: dict[str, float]) -> dict[str, Any]:
    """Return every number that the diagnosis rests on."""
    # What its own test excludes has no probability.
    evidence: dict[str, Any] = {
        f"probability_{name}": None if name in case.excluded else value for name, value in probability.items()
    }
    evidence |= {
        "scatter_typical_um": case.residual.typical_um,
        "scatter_positive_um": case.residual.scatter_um[0],
        "scatter_negative_um": case.residual.scatter_um[1],
        "serial_p": case.serial_p,
        "approach_gain_nats": case.approach_gain,
        "step_p": case.step.p_value,
        "step_um": case.step.coefficient,
        "step_u_um": case.step.coefficient_u,
        "step_cycle": case.step_cycle,
        "step_held_out_nats": case.step.hold_out_gain,
    }
    if case.temperature is not None:
        evidence |= {
            "temperature_p": case.temperature.p_value,
            "temperature_um_per_K": case.temperature.coefficient,
            "temperature_u_um_per_K": case.temperature.coefficient_u,
            "temperature_lag_s": LAGS_S[case.temperature.best],
            "temperature_held_out_nats": case.temperature.hold_out_gain,
            "temperature_warm_up_share": case.warm_up_share,
        }
    return evidence
