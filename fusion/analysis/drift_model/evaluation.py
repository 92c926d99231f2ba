"""What the evidence allows to say of a closed loop, along an axis and on a record.

Readings that an effect was not fitted to bear it out, contradict it, or cannot tell; a name is withheld where something else may be behind
it; errors of predicting the hold-out set and what remains decide the verdict. Procedure and error rates: docs/method/closed-loop.md.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fusion.analysis.diagnosis.residual import ResidualStructure
from fusion.analysis.drift_model.model import Term
from fusion.analysis.drift_model.predictions import rmse
from fusion.analysis.drift_model.record_data import independent
from fusion.analysis.drift_model.search import (
    DISCREPANCY,
    SUPERFLUOUS_GAIN,
    LoopState,
    M,
    Problem,
    Step,
    rivals,
    say,
)
from fusion.analysis.effects.library import describe_effect
from fusion.analysis.levels import ANSWER_LEVEL, DENIAL_LEVEL
from fusion.common import Array
from fusion.results import loop as schema
from fusion.results.numbers import p_words
from fusion.results.parts import Number
from interferometry.drift.gls import estimate
from interferometry.drift.kalman import DriftModelError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

StepT = TypeVar("StepT", bound=schema.StepPart)

# What readings that an effect was not fitted to say of it: regression of these readings on its predicted share.

#: Sizes, over that predicted, between which an effect predicts better than none and than twice as much of it.
_HALF, _TWICE = 0.5, 2.0
#: Readings per column below which an interval says nothing.
_READINGS_PER_COLUMN = 2
#: Share of its length that a column keeps by rounding where the others contain it.
_ROUNDING = 1e-6
#: A size is not told where a right effect would hardly be borne out more often than one that is not there.
_LEAST_POWER = 2.0 * ANSWER_LEVEL


@dataclass(frozen=True)
class Unseen:
    """Readings of one channel that effects were not fitted to, and what is predicted of them, um.

    Attributes
    ----------
    rows : (n,) number of each reading, by which channels share an instant
    seconds, loadings : (n,) and (n, components) of the drift that acts there
    response : (n,) the readings
    beside : (n, q) what may be of any size there beside a level, such as the share of the declared effects
    shares : (n, effects) the predicted share of every effect
    uncertain : (n, r) errors of what was taken from the response beforehand, one column for each of unit variance; None for none
    """

    rows: NDArray[np.intp]
    seconds: Array
    loadings: Array
    response: Array
    beside: Array
    shares: Array
    uncertain: Array | None = None

    def whitened(self) -> tuple[Array, Array, Array, int] | None:
        """Response, shares and uncertain columns freed of `beside` and whitened by the drift and noise of these very readings, and the
        degrees of freedom; None where they cannot be estimated.
        """
        if not self.rows.size:  # A displacement that ended before.
            return None
        level, number = np.ones((self.rows.size, 1)), self.shares.shape[1]
        varying = np.column_stack([self.beside, self.shares])
        design = np.column_stack([level, varying[:, independent(varying)]])
        freedom = self.rows.size - design.shape[1]
        if freedom < _READINGS_PER_COLUMN * design.shape[1]:
            return None
        try:
            fit = estimate(self.seconds, self.loadings, self.response, design, memory=True)
        except DriftModelError:
            return None
        if fit.sigma <= 0.0:
            return None
        rates = fit.design[:, design.shape[1] :]
        asked = np.column_stack(
            [self.response, self.shares, level[:, :0] if self.uncertain is None else self.uncertain]
        )
        laid = fit.system.whiten(np.column_stack([asked, level, self.beside, rates]))[0] / fit.sigma
        asked, beside = laid[:, : asked.shape[1]], laid[:, asked.shape[1] :]
        left = asked - beside @ np.linalg.lstsq(beside, asked, rcond=None)[0]
        # What is of no size beside the others is rounding.
        left[:, np.linalg.norm(left, axis=0) < _ROUNDING * np.linalg.norm(asked, axis=0)] = 0.0
        return left[:, 0], left[:, 1 : 1 + number], left[:, 1 + number :], freedom


@dataclass(frozen=True)
class Answer:
    """Whether readings that an effect was not fitted to bear it out.

    Attributes
    ----------
    slope, u : size with which it acts there over that predicted, 1 where it is right and 0 where it is not there, and its standard
        uncertainty; infinite where these readings do not determine it
    freedom : degrees of freedom of the uncertainty
    level : probability of each false statement
    against : what contradicts the effect without regard to its size, in words
    where : which readings were asked, in words
    """

    slope: float = np.nan
    u: float = np.inf
    freedom: int = 1
    level: float = ANSWER_LEVEL
    against: str = ""
    where: str = "on the hold-out set"

    @property
    def word(self) -> schema.BorneOut:
        """Borne out where its size is more than zero and may be that predicted, contradicted where it is less and may be zero."""
        reach = special.stdtrit(self.freedom, 1.0 - self.level) * self.u
        if self.against:
            return "no"
        if not np.isfinite(reach):
            return "cannot tell"
        there, less, more = self.slope > reach, self.slope + reach < 1.0, self.slope - reach > 1.0
        if there and (self.slope >= _HALF if less else self.slope <= _TWICE or not more):
            return "yes"
        return "no" if less and (not there or self.slope < _HALF) else "cannot tell"

    @property
    def p_value(self) -> float:
        """Probability of a size as large where the effect is not there."""
        return float(special.stdtr(self.freedom, -self.slope / self.u)) if np.isfinite(self.u) else 1.0

    @property
    def power(self) -> float:
        """Probability that such readings bear a right effect out."""
        return float(special.stdtr(self.freedom, 1.0 / self.u - special.stdtrit(self.freedom, 1.0 - self.level)))

    @property
    def is_of_other_size(self) -> bool:
        """Whether its size differs from that predicted by more than chance and the discrepancy of a library's shape explain."""
        wide = np.hypot(self.u, DISCREPANCY)
        return bool(abs(self.slope - 1.0) > special.stdtrit(self.freedom, 1.0 - 0.5 * DENIAL_LEVEL) * wide)

    @property
    def size(self) -> str:
        """Its size in words."""
        return say("unseen", "size", where=self.where, slope=self.slope, expanded_u=2.0 * self.u)

    def described(self) -> dict[str, Any]:
        """What results.json holds of it."""
        known = self.power >= _LEAST_POWER
        doubts = {
            "yes": "",
            "no": self.against or say("unseen", "contradicted", size=self.size),
            "cannot tell": say("unseen", "not_yet" if known else "hardly_changes", size=self.size, where=self.where),
        }
        return {
            "confirmed": self.word == "yes",
            "doubt": doubts[self.word],
            "borne_out": self.word,
            "borne_out_p": self.p_value,
            "borne_out_size": self.slope if known else None,
            "borne_out_size_u": self.u if known else None,
            "borne_out_power": self.power,
        }


def answers(channels: Sequence[Unseen], *, family: int = 1) -> list[Answer]:
    """Ask readings for the size of every effect, all effects together, over that predicted; channels share the sizes.

    ``family`` is the number of effects of the model: with Bonferroni's level none of them is told falsely with the stated probability.
    """
    effects = channels[0].shares.shape[1]
    asked = [(one.rows, *found) for one in channels if (found := one.whitened()) is not None]
    if not asked or not effects:
        return [Answer()] * effects
    known = independent(np.vstack([shares for _, _, shares, _, _ in asked]))
    parts = [(rows, response, shares[:, known], uncertain) for rows, response, shares, uncertain, _ in asked]
    inverse = np.linalg.inv(np.sum([x.T @ x for _, _, x, _ in parts], axis=0))
    slopes = inverse @ np.sum([x.T @ y for _, y, x, _ in parts], axis=0)
    # The drifts of the channels of one machine are alike, so that many channels say little more than one, whenever each was read.
    instants = np.unique(np.concatenate([rows for rows, *_ in parts]))
    left = np.array([_at_nearest(y - x @ slopes, rows, instants) for rows, y, x, _ in parts])
    laid = np.array([_at_nearest(x, rows, instants) for rows, _, x, _ in parts])
    alike = left @ left.T
    # A channel that is predicted exactly has no drift to share.
    size = np.sqrt(np.maximum(np.diag(alike), np.finfo(float).tiny))
    products = np.einsum("kni,lnj->klij", laid, laid)
    covariance = inverse @ np.einsum("kl,klij->ij", alike / np.outer(size, size), products) @ inverse
    for _, _, x, uncertain in parts:
        through = inverse @ x.T @ uncertain
        covariance = covariance + through @ through.T
    freedom = min(found[-1] for found in asked)
    told = {
        k: Answer(float(a), float(u), freedom, ANSWER_LEVEL / family)
        for k, a, u in zip(known, slopes, np.sqrt(np.diag(covariance)), strict=True)
    }
    return [told.get(k, Answer()) for k in range(effects)]


def _at_nearest(values: Array, rows: NDArray[np.intp], instants: NDArray[np.intp]) -> Array:
    """Values (n,) or (n, q) at all instants, each that of the nearest reading; their sum of squares, column by column, is kept."""
    after = np.clip(np.searchsorted(rows, instants), 1, rows.size - 1)
    nearest = after - (instants - rows[after - 1] <= rows[after] - instants)
    laid = values[nearest]
    length = np.linalg.norm(laid, axis=0)
    return np.asarray(
        laid * np.divide(np.linalg.norm(values, axis=0), length, out=np.ones_like(length), where=length > 0.0)
    )


# Why an effect has no name although the readings follow its columns: something else may be behind it.

#: A slow effect may be a part of a smooth drift without a name that is left beside it and has this share of its size.
_SMOOTH_SHARE = 0.5
#: Share of a slow effect that may pass for another of the same pattern: the best single body misses up to 22 % of a bar that conducts
#: heat (95 % of 200 bars; docs/method/closed-loop.md), and the size of what is small is not known to better than a third.
_MISFIT_SHARE = 0.3
#: Cosine of two patterns over the sites from which on they are one.
_ONE_PATTERN = 0.9


@dataclass(frozen=True)
class Contribution:
    """What a term of the final model contributes, about the mean of every site or channel: rms, um; its leading pattern over these, of unit
    length; and the log-likelihood that all readings together lose without it.
    """

    rms_um: float
    pattern: Array
    loss: float


def leading_pattern(series: Array) -> Array:
    """Leading pattern (sites,) of unit length of series (times, sites); NaN where there is no reading."""
    about = np.nan_to_num(series - np.nanmean(series, axis=0))
    return np.asarray(np.linalg.svd(about, full_matrices=False)[2][0])


@dataclass(frozen=True)
class Surroundings:
    """What stands beside the added effects of the final model: rms of the random drift that the model does not name, and whether that is
    smooth; of the readings about the mean of their site or channel, um; and the effects of which another load makes another size, as how
    their heat grows with it is not known.
    """

    drift_um: float
    is_smooth: bool
    total_um: float
    of_own_law: Collection[str] = ()


def reasons_against(
    step: Step,
    answer: Answer,
    own: Contribution,
    before: Sequence[tuple[Term, Contribution, str]],
    beside: Surroundings,
) -> Iterator[str]:
    """Why an added effect has no name; ``before`` are the terms that were added before it, with the reasons against their names."""
    effect, parameters = describe_effect(step.effect), step.score.best.parameters
    # What follows nothing that was logged is a trend since the first reading.
    is_trend = parameters.get("follows", "warm_up") == "warm_up"
    for name, words in (("time_constant_min", "time constant"), ("period_min", "period")):
        # A value of which no other was tried is as open as one of which all fit.
        low, high = step.score.ranges.get(name, [None, None] if name in parameters else [0.0, 0.0])
        by_course = name == "period_min" or is_trend or (effect is not None and effect.excited_by)
        if by_course and (low is None or high is None):
            known = f"{low:.3g} min and more" if low else f"{high:.3g} min and less" if high else "any"
            yield say("withheld", "open_parameter", parameter=words, known=known)
    longest_min, minutes = effect.longest_min if effect else np.inf, float(parameters.get("time_constant_min", 0.0))
    if minutes > longest_min:
        yield say("withheld", "too_long", minutes=minutes, longest_min=longest_min)
    # A walk may be mistaken for a trend as well, and only a smooth drift for what follows a load.
    is_course = "time_constant_min" in parameters and (beside.is_smooth or is_trend)
    if is_course and beside.drift_um >= _SMOOTH_SHARE * own.rms_um:
        kind = "smooth drift" if beside.is_smooth else "drift"
        yield say("withheld", "part_of_drift", kind=kind, drift_um=beside.drift_um, rms_um=own.rms_um)
    nameless = [term.effect for term, _, why in before if why]
    # An instant or a period tells an effect whatever stands beside it.
    if nameless and step.score.best.event_s is None and "period_min" not in parameters:
        yield say("withheld", "beside_nameless", nameless=nameless[0].replace("_", " "))
    for term, other, why in before:
        # What the shape of a larger slow effect of the same pattern may miss: at most a share where that one has a name.
        is_slow, share = "time_constant_min" in term.candidate.parameters, 1.0 if why else _MISFIT_SHARE
        if is_slow and own.rms_um < share * other.rms_um and abs(own.pattern @ other.pattern) > _ONE_PATTERN:
            larger = term.effect.replace("_", " ")
            yield say("withheld", "misfit", rms_um=own.rms_um, larger=larger, larger_um=other.rms_um)
    if own.rms_um > beside.total_um:
        yield say("withheld", "counterbalance", rms_um=own.rms_um, total_um=beside.total_um)
    if answer.is_of_other_size and step.effect not in beside.of_own_law:
        yield say("withheld", "other_size", size=answer.size)
    if own.loss < SUPERFLUOUS_GAIN:
        yield say("withheld", "needless", loss=own.loss)


def describe_steps(
    state: LoopState[M],
    answers: Sequence[Answer],
    contributions: Sequence[Contribution],
    beside: Surroundings,
    *,
    sizes: Sequence[float],
    cross_um: Sequence[tuple[float, float]],
) -> list[dict[str, Any]]:
    """What results.json holds of every step, on a record and along an axis; ``sizes`` are as in `rivals`, ``cross_um`` the errors of
    predicting left-out blocks without each and with it.
    """
    described: list[dict[str, Any]] = []
    for place, (step, answer, own) in enumerate(zip(state.steps, answers, contributions, strict=True)):
        before = zip(state.added, contributions, (one["withheld"] for one in described), strict=False)
        tied, runner_up = rivals(step.score, step.round.scores, sizes[place])
        before_um, after_um, without_um = (np.nan,) * 3
        if not step.is_from_second_search:
            before_um, after_um, without_um = *state.errors_um[place : place + 2], state.errors_without_um[place]
        # The hold-out set does not show when an event happened before it.
        is_unseen = np.isnan(without_um) or step.score.is_event
        unseen_um = cross_um[place] if is_unseen else (without_um, state.errors_um[-1])
        described.append(
            {
                "effect": step.effect,
                "parameters": state.added[place].candidate.parameters,
                "parameter_ranges": step.score.ranges,
                "p_value": step.score.family_wise_p,
                "rmse_before_um": before_um,
                "rmse_after_um": after_um,
                "rmse_without_um": without_um,
                "cross_rmse_before_um": cross_um[place][0],
                "cross_rmse_after_um": cross_um[place][1],
                "rms_um": own.rms_um,
                "tied": tied,
                "lowers_error": unseen_um[1] * schema.ERROR_BY_CHANCE < unseen_um[0],
                "withheld": next(reasons_against(step, answer, own, list(before), beside), ""),
                "runner_up": runner_up,
                **answer.described(),
                "confirmed_by": str(step.confirmed),
            }
        )
    return described


# What follows from it: whether the model has skill, and the verdict.


def unsupported_places(steps: Sequence[schema.StepPart]) -> list[int]:
    """Return the places of the added effects that readings which they were not fitted to contradict, or are predicted no better with."""
    return [place for place, step in enumerate(steps) if not step.keeps_name]


def left_out_of_forecast(problem: Problem[M], state: LoopState[M], unsupported: Collection[int]) -> set[int]:
    """Places of the steps that leave the forecast: unsupported ones, and those with which the hold-out set is predicted worse."""
    steps = range(len(state.errors_without_um))
    left = set(unsupported) & set(steps)
    while left != set(steps) and problem.hold_out_error(state.kept(left)) > schema.ERROR_BY_CHANCE * state.errors_um[0]:
        left.add(min(set(steps) - left, key=lambda place: problem.hold_out_error(state.kept(left | {place}))))
    return left


def named_in_forecast(steps: Sequence[StepT], away: Collection[int]) -> list[StepT]:
    """The steps, of which one that left the forecast keeps its name only where unseen readings bear it out."""
    return [
        step.model_copy(update={"lowers_error": False}) if place in away and step.borne_out != "yes" else step
        for place, step in enumerate(steps)
    ]


def exceeds_noise(error_um: float, noise_um: float, share: float) -> bool:
    """Whether an error holds more than noise."""
    return error_um**2 > (1.0 + share**2) * noise_um**2


def has_skill(error_um: float, last_value_um: float, mean_um: float, noise_um: float, share: float) -> bool:
    """Whether a model predicts the hold-out set better than the last value and the mean of the training part do."""
    return error_um < min(last_value_um, mean_um) or not exceeds_noise(error_um, noise_um, share)


#: What is left where a model with a name predicts neither to within the noise nor as well as the best plain prediction.
BEYOND_PLAIN = say("remainder", "beyond_plain")
#: A plain regression whose error is this share of the model's or less knows something that the model lacks.
_BETTER = 0.75


def is_separable(error_um: float, ridge_with_lags_um: float) -> bool:
    """Whether a cause can be named: a plain regression with lagged copies does not predict better by a quarter."""
    return not ridge_with_lags_um <= _BETTER * error_um


def verdict(*, named: bool, left: bool, skill: bool, separable: bool, tested: bool) -> schema.Verdict:
    """Word for the outcome."""
    if not skill and not tested and separable:
        return "no_skill"
    left = left or tested or not separable
    if named and separable:
        return "partial" if left else "explained"
    return "unexplained" if left else "complete"


def errors_of_predictions(hold_out: Mapping[str, schema.HeldOutError]) -> dict[str, Any]:
    """Errors on the hold-out set, as ``errors``, ``baselines`` and ``best_baseline`` of a `Loop`."""
    plain = {name: one for name, one in hold_out.items() if name not in schema.ModelErrors.model_fields}
    return {
        "errors": schema.ModelErrors(**{name: hold_out[name] for name in schema.ModelErrors.model_fields}),
        "baselines": schema.RunBaselines(**plain) if "mean_run" in plain else schema.Baselines(**plain),
        "best_baseline": min(plain, key=lambda name: plain[name].rmse_um),  # type: ignore[arg-type, return-value]
    }


def shares_of_drift(parts: Sequence[Array], left: Array) -> tuple[list[float], float]:
    """Shares of a drift's variance by the effects (n,) or (n, channels) that make it, and the share that is left beside them.

    What the effects explain together is divided among them by their covariance with their sum, so that it is negative for an effect that
    cancels a part of another.
    """
    explained = np.sum([np.zeros(left.shape), *parts], axis=0)
    total, together = (float(np.nanmean(one**2)) for one in (explained + left, explained))
    if not total or not together:
        return [0.0 for _ in parts], 1.0
    share = min(1.0, float(np.nanmean(left**2)) / total)
    return [(1.0 - share) * float(np.nanmean(one * explained)) / together for one in parts], share


def _words_of(parameter: tuple[str, Any]) -> str:
    """Name and value of a parameter, numbers to three digits."""
    name, value = parameter
    return f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"


def _expected(error: schema.HeldOutError) -> str:
    """What the model expects of its error, after it; empty where that is not known."""
    if not isinstance(error, schema.ModelError) or error.expected_um is None:
        return ""
    if error.expected_low_um is None or error.expected_high_um is None:
        return f" ({error.expected_um:.3g} µm expected)"
    return f" ({error.expected_low_um:.3g} to {error.expected_high_um:.3g} µm expected)"


@dataclass(frozen=True, repr=False)
class LoopResult:
    """Result of the closed loop; it prints a summary, and `plot` draws its errors.

    Attributes
    ----------
    state : LoopState
        The last state of the loop: every round and every decision.
    held_out : str
        What was held out, in words.
    noise_floor_um : float, um
        Standard deviation of one reading about the final model, of a record mean over the channels.
    hold_out_errors : mapping of str to (n_held_out,) or (n_held_out, channels) ndarray, um
        Errors of predicting the hold-out set by the declared and the final model, as ``declared`` and ``final``, and by plain predictions.
    hold_out : mapping of str to HeldOutError
        Their root mean squares by the same names; of the model with what it expects of them.
    skill_um : float, um
        Error on the hold-out set by which the skill of the model is judged; one that holds an effect of the second look, an event among the
        held-out cycles, is carried through them by the readings of half of the targets, which favours it beside the last value.
    tracking : Tracking or None
        Errors on the hold-out set with a reading from time to time, None for several runs.
    steps : list of StepPart
        Effects that were added.
    away : frozenset of int
        Places of the added effects without which the final error is predicted.
    remainder : ResidualStructure
        Structure that the final model leaves.
    wandering_um : float, um
        Root mean square of the random drift beside everything that the model names.
    warm_up_only : tuple of str
        Declared effects that the readings show by one warm-up alone.
    """

    #: What may be left beside the noise, as a multiple of it, and the level at which an effect without a name shows that something is left.
    noise_share: ClassVar[float]
    level: ClassVar[float]

    state: LoopState[Any]
    held_out: str
    noise_floor_um: float
    hold_out_errors: Mapping[str, Array]
    hold_out: Mapping[str, schema.HeldOutError]
    skill_um: float
    tracking: schema.Tracking | None
    steps: Sequence[schema.StepPart]
    away: frozenset[int]
    remainder: ResidualStructure
    wandering_um: float
    warm_up_only: tuple[str, ...]

    def __repr__(self) -> str:
        added = ", ".join(f"{step.effect} ({p_words(step.p_value)})" for step in self.steps) or "nothing"
        return (
            f"LoopResult: {self.verdict}; declared {', '.join(self.declared) or 'nothing'}; added {added}; "
            f"held-out error {self.rmse_declared_um:.3g} -> {self.rmse_final_um:.3g} um"
        )

    def __str__(self) -> str:
        return "\n".join(f"{name}: {text}" for name, text in self._summary())

    def _repr_html_(self) -> str:
        rows = (f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in self._summary())
        return f"<table>{''.join(rows)}</table>"

    def _summary(self) -> list[tuple[str, str]]:
        """Names and texts of what was found."""
        added = [
            (
                "added",
                f"{step.effect} ({', '.join(map(_words_of, step.parameters.items()))}), {p_words(step.p_value)}, "
                f"{step.doubt or 'borne out'}",
            )
            for step in self.steps
        ]
        return [
            ("verdict", self.verdict.replace("_", " ")),
            ("declared", ", ".join(self.declared) or "nothing"),
            *(added or [("added", "nothing")]),
            ("held out", self.held_out),
            (
                "held-out error",
                f"{self.rmse_declared_um:.3g} -> {self.rmse_final_um:.3g} µm{_expected(self.hold_out['final'])}",
            ),
            ("last value repeated", f"{self.rmse_persistence_um:.3g} µm"),
            ("noise floor", f"{self.noise_floor_um:.3g} µm"),
            ("what remains", self.remainder.shape or "nothing that these data show"),
        ]

    def plot(self, ax: Axes | None = None) -> Axes:
        """Plot the errors on the hold-out set, and what the model expects of its own; see `fusion.results.plots.plot_loop`."""
        from fusion.results.plots import plot_loop

        return plot_loop(self, ax)

    @property
    def declared(self) -> list[str]:
        """Names of the declared effects."""
        return [term.effect for term in self.state.declared]

    @property
    def rmse_persistence_um(self) -> Number:
        """Hold-out error of repeating the last value of the training part, um."""
        return self.hold_out["last_value"].rmse_um

    @property
    def rmse_declared_um(self) -> float:
        """Hold-out error of the declared model, um."""
        return self.state.errors_um[0]

    @property
    def rmse_final_um(self) -> float:
        """Hold-out error with the effects that were decided on the training part, those that left the forecast excluded, um."""
        return rmse(self.hold_out_errors["final"])

    @property
    def unnamed(self) -> dict[str, float]:
        """Effects that are significant and have no name, with their p-value."""
        return self.state.unnamed(self.level)

    @property
    def verdict(self) -> schema.Verdict:
        """Word for the outcome."""
        return self.judge(
            self._errors_um, skill_um=self.skill_um, remains=bool(self.remainder.shape) or self._falls_short
        )

    def judge(self, errors_um: Mapping[str, float], *, skill_um: float, remains: bool) -> schema.Verdict:
        """Word for the outcome by the errors of all predictions on some held-out readings."""
        mean_um = min(errors_um["mean"], errors_um.get("mean_run", np.inf))
        return verdict(
            named=any(self._kept),
            left=remains or not all(self._kept),
            tested=bool(self.unnamed) or self.remainder.is_tested,
            skill=has_skill(skill_um, errors_um["last_value"], mean_um, self.noise_floor_um, self.noise_share),
            separable=is_separable(errors_um["final"], errors_um["ridge_with_lags"]),
        )

    @property
    def separable(self) -> bool:
        """Whether a cause can be named: ridge regression with lagged copies does not predict better by a quarter."""
        return is_separable(self._errors_um["final"], self._errors_um["ridge_with_lags"])

    @property
    def _errors_um(self) -> dict[str, float]:
        """Errors of the predictions of the hold-out set, um."""
        return {name: float(one.rmse_um or 0.0) for name, one in self.hold_out.items()}

    @property
    def _kept(self) -> list[bool]:
        """For every step whether its name stands."""
        return [step.keeps_name and not step.withheld for step in self.steps]

    @property
    def _falls_short(self) -> bool:
        """Whether there is a name, and the final error exceeds the noise and that of the best plain prediction."""
        # No forecast holds an event among the held-out cycles, which has no held-out error of its own.
        unforeseen = any(np.isnan(np.float64(step.rmse_after_um)) for step in self.steps)
        final_um = self.skill_um if unforeseen else self._errors_um["final"]
        plain_um = min(um for name, um in self._errors_um.items() if name not in schema.ModelErrors.model_fields)
        exceeds = exceeds_noise(final_um, self.noise_floor_um, self.noise_share)
        return any(self._kept) and exceeds and final_um > plain_um

    def _described(self) -> dict[str, Any]:
        """What results.json holds of every loop, along an axis and on a record."""
        return {
            "declared": self.declared,
            "held_out": self.held_out,
            "noise_floor_um": self.noise_floor_um,
            "rmse_persistence_um": self.rmse_persistence_um,
            "rmse_declared_um": self.rmse_declared_um,
            "rmse_final_um": self.rmse_final_um,
            **errors_of_predictions(self.hold_out),
            "steps": self.steps,
            "verdict": self.verdict,
            "unconfirmed_effects": self.unnamed,
            "separable": self.separable,
            "wandering_um": self.wandering_um,
            "warm_up_only": self.warm_up_only,
            "drift_um": self._drift_um,
            "followed": self._followed[0],
            "tracking": self.tracking,
            "left_out_of_forecast": tuple(self.steps[place].effect for place in sorted(self.away)),
            "unexplained": self.unexplained,
            "not_tried": self.state.not_tried(),
            "not_admitted": self.state.blocked(),
        }

    @property
    @abstractmethod
    def unexplained(self) -> schema.Unexplained:
        """What is left."""

    @property
    def _terms(self) -> Sequence[Term]:
        """Terms of the final model, in the order of `_drift`."""
        return self.state.model.terms

    @property
    @abstractmethod
    def _drift(self) -> list[Array]:
        """What every term of the final model makes of the drift, and last what is left, (n,) or (n, channels) about their means, um."""

    @property
    def _drift_um(self) -> float:
        """Root mean square of the drift about its means, um."""
        return float(np.sqrt(np.nanmean(np.sum(self._drift, axis=0) ** 2)))

    @property
    def _followed(self) -> tuple[list[schema.DriftShare], float]:
        """Shares of the drift by what it follows, and the share of what is left; of that is what unseen readings do not support."""
        *parts, left = self._drift
        names = [term.effect for term in self._terms]
        # Errors of the camera that were taken out of the fields are steps, and no terms of the model any more.
        steps = [step for step in self.steps if step.effect in names]
        away = {len(self.declared) + place for place in unsupported_places(steps)}
        left = left + np.sum([np.zeros(left.shape), *(parts[place] for place in away)], axis=0)
        kept = [place for place in range(len(parts)) if place not in away]
        shares, rest = shares_of_drift([parts[place] for place in kept], left)
        return [
            schema.DriftShare(effect=names[place], share=one) for place, one in zip(kept, shares, strict=True)
        ], rest

    def _left(self) -> dict[str, Any]:
        """Shape, size and p-value of what is left."""
        left = self.remainder
        shape = left.shape or (BEYOND_PLAIN if self._falls_short else "")
        # The held-out error of a drift that is carried on at its rate says nothing of the size of what drifts.
        # A model that cancels a part of the random drift leaves no more than all of the drift.
        wandering_um = min(self.wandering_um, self._drift_um)
        beside_noise = max(0.0, self._errors_um["final"] ** 2 - self.noise_floor_um**2) ** 0.5
        size = max(left.rms_um or beside_noise, wandering_um)
        # What a step without a name describes is not explained either, whether a shape is left beside it or not.
        nameless = [step.rms_um or 0.0 for step, kept in zip(self.steps, self._kept, strict=True) if not kept]
        size = float(np.linalg.norm([size if shape else 0.0, *nameless]))
        return {"shape": shape, "rms_um": size, "share": self._followed[1], "p_value": left.p_value}
