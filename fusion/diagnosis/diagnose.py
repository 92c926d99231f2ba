"""The cause of an anomaly, with its probability, the evidence for and against it, and what to check on the machine.

Explanations compete by likelihood: scatter (structural), scatter or creep bound to the direction of approach (stick-slip), local
temperature through a first-order lag, a step, and a slow walk that none of these explains. A cause is named only where its
probability passes a threshold set on simulated campaigns, its own test rejects chance, and what one direction teaches predicts the
other; otherwise the answer is "undetermined". A false verdict costs more than none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from fusion.diagnosis.explanations import (
    LAGS_S,
    Lasting,
    Residual,
    Slow,
    fit_lasting,
    fit_slow,
    lagged_temperature,
    local_residuals,
    serial_p,
    step_columns,
    step_instant,
    warm_up_like,
)
from fusion.diagnosis.scatter import Memoryless, memoryless_likelihoods

Cause = Literal["structural", "local_temperature", "stick_slip", "step", "undetermined"]

#: Least probability of each cause. tests/fusion/test_diagnosis_thresholds.py sets and checks them on simulated campaigns.
THRESHOLDS: dict[str, float] = {"structural": 0.3, "local_temperature": 0.8, "stick_slip": 0.4, "step": 0.6}
#: What an effect bound to the approach must gain beyond scatter that is alike in both directions before it counts as likely (nats):
#: amounts that follow the motion, more scatter in one direction, a slow walk in one direction (beside its parameter). Plain scatter
#: exceeds one of them by chance in about one case of twenty.
APPROACH_NATS = {"along": 2.1, "one_direction": 4.0, "slow": 2.0}
#: A local temperature of which at least this share follows the exponentials of one warm-up explains whatever else is slow as well.
WARM_UP_SHARE = 0.98
#: Level of the bootstrap test that a lasting cause must pass; local temperature is the name that costs most when it is wrong.
LEVELS = {"step": 0.05, "local_temperature": 0.02}

CHECKS: dict[str, str] = {
    "structural": "guideway, screw and nut at this position: preload, wear, contamination, loose scale or cover; repeat at small "
    "steps around it",
    "local_temperature": "what heats the table here (drive, pipe, chips, sun); repeat with that source switched on and off",
    "stick_slip": "lubrication, seals and wipers, drive gain at low speed; repeat at another feed rate and after lubrication",
    "step": "fixture, optics and clamps at the time of the step; look for an event in the machine's log",
    "undetermined": "repeat with a varied duty cycle and a temperature sensor at this position, or with more cycles",
}


class Flagged(Protocol):
    """What a diagnosis needs of an anomaly: :class:`interferometry.anomalies.Anomaly` has it."""

    @property
    def target(self) -> int:
        """Target number, from 1."""

    @property
    def direction(self) -> str:
        """Direction(s) that stand out: ``"positive"``, ``"negative"`` or ``"both"``."""


@dataclass(frozen=True)
class Diagnosis:
    """Verdict on one anomaly.

    Attributes
    ----------
    cause : name of the cause, "undetermined" where the data do not decide
    probability : of that cause among the explanations tried; for "undetermined" that of the best explanation
    evidence : numbers by name (um, K, s, nats or probabilities, as the name says)
    for_it, against_it : sentences with numbers
    check : what to look at on the machine
    """

    target: int
    direction: str
    cause: Cause
    probability: float
    evidence: dict[str, Any]
    for_it: tuple[str, ...]
    against_it: tuple[str, ...]
    check: str


@dataclass(frozen=True)
class _Case:
    """All fits of one target."""

    residual: Residual
    slow: Slow
    memoryless: Memoryless
    temperature: Lasting | None
    step: Lasting
    serial_p: float
    warm_up_share: float


@threadpool_limits.wrap(limits=1, user_api="blas")
def diagnose(anomalies: Sequence[Flagged], fused: xr.Dataset, *, seed: int = 0) -> list[Diagnosis]:
    """Name the cause of every anomaly.

    Parameters
    ----------
    anomalies : sequence
        Flagged targets; all of them are kept out of the drift that is subtracted.
    fused : Dataset
        Of :func:`fusion.alignment.align.align`: ``deviation``, ``time``, ``position`` and, where the camera sees the targets,
        ``local_rise_series`` (frame_time, target) in K.
    seed : int
        Seed of the bootstrap.

    Returns
    -------
    list of Diagnosis
        One per anomaly, in the same order.

    Raises
    ------
    DiagnosisError
        if a target is unknown, has fewer than 12 cycles, or fewer than 3 targets are free of anomalies.
    """
    flagged = {int(one.target) for one in anomalies}
    cases = {target: _examine(fused, target, flagged, seed) for target in sorted(flagged)}
    return [_judge(cases[int(one.target)], str(one.direction)) for one in anomalies]


def _examine(fused: xr.Dataset, target: int, flagged: set[int], seed: int) -> _Case:
    rng = np.random.default_rng([seed, target])
    residual = local_residuals(fused, target, flagged)
    columns = lagged_temperature(residual)
    temperature = None if columns is None else fit_lasting(residual, columns, rng)
    return _Case(
        residual=residual,
        slow=fit_slow(residual),
        memoryless=memoryless_likelihoods(residual),
        temperature=temperature,
        step=fit_lasting(residual, step_columns(residual.seconds.size), rng),
        serial_p=serial_p(residual, rng),
        warm_up_share=0.0 if columns is None else warm_up_like(residual.seconds, columns[:, 0]),
    )


def weigh(case: _Case) -> dict[str, float]:
    """Probabilities of the causes and of "slow" (a walk without a name), equal before the data.

    Likelihoods are at their maximum; each free parameter costs half the logarithm of the number of cycles (Schwarz 1978, Ann.
    Stat. 6, 461) and each searched member the logarithm of their number. A lasting cause whose own test does not reject chance has
    no weight.
    """
    cycles = case.residual.seconds.size
    one = 0.5 * float(np.log(cycles))
    scatter = case.memoryless
    sticking = float(
        np.logaddexp(
            scatter.one_direction - APPROACH_NATS["one_direction"], scatter.along_approach - APPROACH_NATS["along"]
        )
    )
    share = 1.0 / (1.0 + float(np.exp(np.clip(scatter.both - sticking, -50, 50))))
    score = {
        "structural": case.slow.white + float(np.log(max(1.0 - share, 1e-30))),
        "stick_slip": max(
            case.slow.white + float(np.log(max(share, 1e-30))),
            case.slow.one_direction - one - APPROACH_NATS["slow"],
        ),
        "slow": case.slow.shared - one,
        "step": case.step.log_likelihood - one - float(np.log(step_columns(cycles).shape[1])),
    }
    if case.temperature is not None:
        score["local_temperature"] = case.temperature.log_likelihood - one - float(np.log(len(LAGS_S)))
    for name, fitted in _lasting(case).items():
        if fitted.p_value > LEVELS[name]:
            score[name] = -np.inf
    highest = max(score.values())
    weight = {name: float(np.exp(value - highest)) for name, value in score.items()}
    total = sum(weight.values())
    return {name: value / total for name, value in weight.items()}


def _lasting(case: _Case) -> dict[str, Lasting]:
    """The explanations with a bootstrap test of their own."""
    return {"step": case.step} | ({"local_temperature": case.temperature} if case.temperature is not None else {})


def _judge(case: _Case, direction: str) -> Diagnosis:
    probability = weigh(case)
    leading = max(probability, key=lambda name: probability[name])
    against = _objections(case, leading, probability[leading])
    cause: Cause = "undetermined" if against or leading == "slow" else leading  # type: ignore[assignment]
    runner_up = max((name for name in probability if name != leading), key=lambda name: probability[name])
    against.append(f"next best explanation: {runner_up}, probability {probability[runner_up]:.2f}")
    against += [
        f"{name}: p = {fitted.p_value:.3f}, a slow walk alone looks like this too often"
        for name, fitted in _lasting(case).items()
        if fitted.p_value > LEVELS[name]
    ]
    return Diagnosis(
        target=case.residual.target,
        direction=direction,
        cause=cause,
        probability=probability[leading],
        evidence=_evidence(case, probability),
        for_it=tuple(_support(case, leading)),
        against_it=tuple(against),
        check=CHECKS[cause],
    )


def _objections(case: _Case, leading: str, probability: float) -> list[str]:
    """Reasons not to name the leading explanation; none left means that it is named."""
    reasons = []
    threshold = THRESHOLDS.get(leading, 0.0)
    if probability < threshold:
        reasons.append(f"probability {probability:.2f} of {leading} is below its threshold {threshold:.2f}")
    lasting = _lasting(case).get(leading)
    if lasting is not None and lasting.held_out <= 0:
        reasons.append(f"what one direction teaches does not predict the other ({lasting.held_out:+.1f} nats held out)")
    if leading == "local_temperature" and case.temperature is not None:
        first, second = case.temperature.by_direction
        if first * second < 0:
            reasons.append(f"the sign differs between directions ({first:+.3f} and {second:+.3f} um/K)")
        if case.warm_up_share >= WARM_UP_SHARE:
            reasons.append(
                f"{case.warm_up_share:.1%} of the local temperature is one warm-up curve: not separable from any other slow cause"
            )
    if leading == "slow":
        reasons.append(f"slow (serial p = {case.serial_p:.3f}), but neither local temperature nor one step explains it")
    return reasons


def _support(case: _Case, leading: str) -> list[str]:
    """Sentences for the leading explanation."""
    residual = case.residual
    scatter = float(np.nanstd(residual.values))
    sentences = [f"scatter {scatter:.2f} um where the other targets show {residual.typical_um:.2f} um"]
    if leading == "step":
        at = int(residual.cycle[step_instant(case.step.place)])
        sentences.append(
            f"step of {case.step.coefficient:+.2f} +- {case.step.coefficient_u:.2f} um at cycle {at} (p = {case.step.p_value:.3f}), "
            f"held out {case.step.held_out:+.1f} nats"
        )
    elif leading == "local_temperature" and case.temperature is not None:
        found = case.temperature
        sentences.append(
            f"{found.coefficient:+.3f} +- {found.coefficient_u:.3f} um per K of local rise, lag {LAGS_S[found.place]:.0f} s "
            f"(p = {found.p_value:.3f}), held out {found.held_out:+.1f} nats"
        )
    elif leading == "stick_slip":
        first, second = residual.scatter_um
        sentences.append(f"scatter {first:.2f} um from the positive side, {second:.2f} um from the negative side")
        gain = max(case.memoryless.one_direction, case.memoryless.along_approach) - case.memoryless.both
        sentences.append(f"an effect bound to the approach explains the readings better by {gain:+.1f} nats")
    elif leading == "structural":
        sentences.append(f"no order in time (serial p = {case.serial_p:.3f}), alike in both directions")
    return sentences


def _evidence(case: _Case, probability: dict[str, float]) -> dict[str, Any]:
    """Every number the verdict rests on."""
    evidence: dict[str, Any] = {f"probability_{name}": value for name, value in probability.items()}
    evidence |= {
        "scatter_typical_um": case.residual.typical_um,
        "scatter_positive_um": case.residual.scatter_um[0],
        "scatter_negative_um": case.residual.scatter_um[1],
        "serial_p": case.serial_p,
        "approach_gain_nats": max(case.memoryless.one_direction, case.memoryless.along_approach) - case.memoryless.both,
        "step_p": case.step.p_value,
        "step_um": case.step.coefficient,
        "step_u_um": case.step.coefficient_u,
        "step_cycle": int(case.residual.cycle[step_instant(case.step.place)]),
        "step_held_out_nats": case.step.held_out,
    }
    if case.temperature is not None:
        evidence |= {
            "temperature_p": case.temperature.p_value,
            "temperature_um_per_K": case.temperature.coefficient,
            "temperature_u_um_per_K": case.temperature.coefficient_u,
            "temperature_lag_s": LAGS_S[case.temperature.place],
            "temperature_held_out_nats": case.temperature.held_out,
            "temperature_warm_up_share": case.warm_up_share,
        }
    return evidence
