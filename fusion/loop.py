"""L4 - The closed loop: model the drift, find what the model lacks, name it or leave it unnamed, and prove it on unseen cycles.

The last fifth of the cycles is sealed. On the others the declared model is fitted, the library of effects is searched, and an effect
enters only if its gain exceeds what the whole search finds by chance where nothing is missing, and holds on readings that its
coefficients were not fitted to. Then the seal is opened once: the error before and after is that of predicting the sealed cycles in
open loop with frozen coefficients. Procedure and its error rates: statistics study, section 3.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion import adequacy
from fusion.effects import Effect, Member, cycle_starts, library
from fusion.gates import blocked_reason
from fusion.model import ModelFit, Term, fit_model, refit_fixed
from fusion.readings import Readings
from fusion.scoring import FamilyScore, Judge, simulate_null
from interferometry.statespace import Array, DriftModelError

#: Chance of adding an effect where nothing is missing, over the whole search.
ENTRY_LEVEL = 0.05
#: Chance that an effect which is not there passes its confirmation on unused readings; the search has been paid for already.
CONFIRMATION_LEVEL = 0.2
#: The same chance for the second look, after the seal has been opened.
SECOND_LEVEL = 0.02
SEALED_SHARE = 0.2
#: Effects whose log-likelihoods differ by less than this (odds of 20 to 1) are reported as a tie.
TIE_GAIN = 3.0
MOST_EFFECTS = 4
#: More events than this are no events but a switching that the library has no name for.
MOST_EVENTS = 2
_BLOCKS = 10
_MAY_REPEAT = frozenset({"step_event", "camera_offset", "sensor_fault", "periodic_disturbance"})

Progress = Callable[[int, int, str], None]
Chosen = list[tuple[FamilyScore, list[FamilyScore]]]


class LoopError(ValueError):
    """The campaign cannot be modelled; the message says what is missing."""


@dataclass(frozen=True)
class Step:
    """An effect that was added.

    Attributes
    ----------
    effect, parameters, coefficients : what was added; coefficients by unit as (value, standard uncertainty), from all cycles
    p_value : chance that the search adds any effect where nothing is missing
    held_out_p : chance of its gain on unused readings where it is not there
    rmse_before_um, rmse_after_um : open-loop error on the sealed cycles without and with it
    rms_um : size of its contribution, root mean square after the static profile is removed
    tied : effects that these data cannot tell from it
    runner_up : the next best effect, its gain and how far behind it is in log-likelihood
    confirmed : how it was confirmed
    """

    effect: str
    parameters: Mapping[str, float | str]
    coefficients: list[dict[str, float | str]]
    p_value: float
    held_out_p: float
    rmse_before_um: float
    rmse_after_um: float
    rms_um: float
    tied: list[str]
    runner_up: dict[str, float | str]
    confirmed: str


@dataclass(frozen=True)
class LoopResult:
    """Everything the loop found; see DESIGN of results.json for the meaning of the verdicts."""

    declared: list[str]
    declared_coefficients: list[dict[str, float | str]]
    held_out: str
    noise_floor_um: float
    rmse_persistence_um: float
    rmse_declared_um: float
    rmse_final_um: float
    steps: list[Step]
    verdict: str
    remainder: adequacy.Remainder
    rounds: list[list[FamilyScore]]
    not_tried: dict[str, str]
    blocked: dict[str, str]
    nuisance: dict[str, float | str]
    before: ModelFit
    after: ModelFit
    sealed: NDArray[np.bool_]
    warnings: list[str] = field(default_factory=list)

    def as_json(self) -> dict[str, object]:
        """The ``loop`` part of results.json."""
        return {
            "declared": self.declared,
            "declared_coefficients": self.declared_coefficients,
            "held_out": self.held_out,
            "noise_floor_um": self.noise_floor_um,
            "rmse_persistence_um": self.rmse_persistence_um,
            "rmse_declared_um": self.rmse_declared_um,
            "rmse_final_um": self.rmse_final_um,
            "steps": [_step_json(step) for step in self.steps],
            "verdict": self.verdict,
            "unexplained": {
                "shape": self.remainder.shape,
                "rms_um": self.remainder.rms_um,
                "p_value": self.remainder.p_value,
                "nearest": self.rounds[-1][0].name if self.remainder.shape and self.rounds and self.rounds[-1] else "",
            },
            "nuisance": self.nuisance,
            "search": [[_score_json(score) for score in scores] for scores in self.rounds],
            "not_tried": self.not_tried,
            "blocked": self.blocked,
        }


def _step_json(step: Step) -> dict[str, object]:
    return {**vars(step), "parameters": dict(step.parameters)}


def _score_json(score: FamilyScore) -> dict[str, object]:
    return {
        "effect": score.name,
        "parameters": dict(score.member.parameters) if score.member else {},
        "gain": score.gain,
        "excess_gain": score.excess,
        "p_value": score.p_value,
        "family_wise_p": score.family_wise_p,
        "held_out_gain": score.held_out_gain,
        "held_out_p": score.held_out_p,
        "share_not_separable": score.collinear,
    }


# Threaded BLAS is many times slower than one thread on matrices of a few dozen columns.
@threadpool_limits.wrap(limits=1, user_api="blas")
def close_loop(
    readings: Readings,
    declared: Sequence[str],
    *,
    seed: int = 1,
    set_aside: Collection[tuple[int, str]] = (),
    effects: Mapping[str, Effect] | None = None,
    progress: Progress | None = None,
) -> LoopResult:
    """Close the loop on a positioning campaign.

    Parameters
    ----------
    readings : what was measured, seen and logged
    declared : names of the effects the user believes to act
    seed : of the simulated campaigns behind the p-values, so that a run can be repeated
    set_aside : sites (target, direction) whose anomaly has its own diagnosis
    effects : the library; the built-in one with the user's own by default

    Raises
    ------
    LoopError
        if fewer than 10 cycles are there, or a declared effect cannot be computed from these readings.
    """
    effects = library() if effects is None else effects
    rng = np.random.default_rng(seed)
    report = progress or (lambda done, total, what: None)
    used, description = _seal(readings)
    terms = _declare(readings, declared, effects)
    report(0, MOST_EFFECTS + 2, "fitting the declared model")
    search = _Search(readings, used, effects, rng, seed)
    models, rounds = [search.fit(terms)], list[list[FamilyScore]]()
    chosen: Chosen = []
    while len(chosen) < MOST_EFFECTS:
        report(len(chosen) + 1, MOST_EFFECTS + 2, f"searching for effect {len(chosen) + 1}")
        scores = search.scores(models[-1])
        rounds.append(scores)
        best = search.choose(scores, models[-1])
        if best is None:
            break
        chosen.append((best, scores))
        models.append(search.fit([*models[-1].terms, Term(best.name, _member(best))], models[-1]))
        models, chosen = _re_examine(search, models, chosen, len(terms))
        if sum(score.name == "step_event" for score, _ in chosen) > MOST_EVENTS:
            models, chosen = _without_events(search, models, chosen)
            break
    report(MOST_EFFECTS, MOST_EFFECTS + 2, "opening the sealed cycles")
    errors = [_rmse(model.open_loop_errors()[0]) for model in models]
    whole = fit_model(readings, models[-1].terms)
    steps = [
        _step(whole, whole.terms[len(terms) + k], score, scores, errors[k], errors[k + 1])
        for k, (score, scores) in enumerate(chosen)
    ]
    report(MOST_EFFECTS + 1, MOST_EFFECTS + 2, "second look, at all cycles")
    whole, steps = _second_look(search, whole, steps, errors[-1], rounds)
    remainder = adequacy.examine(readings, whole.fit, rng, set_aside=set_aside)
    report(MOST_EFFECTS + 2, MOST_EFFECTS + 2, "loop closed")
    return LoopResult(
        declared=list(declared),
        declared_coefficients=[
            {"effect": term.effect, **entry}
            for term in whole.terms[: len(terms)]
            for entry in _coefficients(whole, term)
        ],
        held_out=description,
        noise_floor_um=whole.fit.sigma,
        rmse_persistence_um=_persistence(readings, used),
        rmse_declared_um=errors[0],
        rmse_final_um=steps[-1].rmse_after_um if steps else errors[0],
        steps=steps,
        verdict=_verdict(bool(steps), bool(remainder.shape)),
        remainder=remainder,
        rounds=rounds,
        not_tried=search.not_tried,
        blocked=search.blocked,
        nuisance=_nuisance(whole),
        before=models[0],
        after=whole,
        sealed=~used,
    )


def _verdict(added: bool, left: bool) -> str:
    if added:
        return "partial" if left else "explained"
    return "unexplained" if left else "complete"


def _seal(readings: Readings) -> tuple[NDArray[np.bool_], str]:
    """Readings that the search may use, and a sentence that says which cycles are sealed."""
    numbers = np.unique(readings.cycle)
    if numbers.size < 10:
        raise LoopError(
            f"{numbers.size} cycles are too few to hold some out and to model the others; measure at least 10, better 50"
        )
    first = numbers[-max(2, round(SEALED_SHARE * numbers.size))]
    used = readings.cycle < first
    return (
        used,
        f"cycles {first}-{numbers[-1]} sealed; coefficients frozen at cycle {first - 1}, drift state carried in open loop",
    )


def _declare(readings: Readings, declared: Sequence[str], effects: Mapping[str, Effect]) -> list[Term]:
    terms = []
    for name in declared:
        if name not in effects:
            raise LoopError(f"declared effect {name!r} is not in the library: {', '.join(effects)}")
        reason = effects[name].needs(readings)
        if reason is not None:
            raise LoopError(f"declared effect {name!r} cannot be computed: {reason}")
        members = list(effects[name].members(readings, {}))
        if len(members) != 1:
            raise LoopError(
                f"declared effect {name!r} has parameters that are not known beforehand; leave it out of [model] declared, the "
                "search tries it anyway"
            )
        terms.append(Term(name, members[0]))
    return terms


class _Search:
    """The search on the readings that are not sealed."""

    def __init__(
        self,
        readings: Readings,
        used: NDArray[np.bool_],
        effects: Mapping[str, Effect],
        rng: np.random.Generator,
        seed: int,
    ) -> None:
        self.readings, self.used, self.effects, self.rng, self.seed = readings, used, effects, rng, seed
        self.not_tried = {
            name: reason for name, effect in effects.items() if (reason := effect.needs(readings)) is not None
        }
        self.blocked: dict[str, str] = {}

    def fit(self, terms: Sequence[Term], like: ModelFit | None = None) -> ModelFit:
        return fit_model(self.readings, terms, used=self.used, like=like.fit if like else None)

    def _families(self, model: ModelFit) -> dict[str, list[Member]]:
        present = {term.effect for term in model.terms}
        families = {}
        for name, effect in self.effects.items():
            if name in self.not_tried:
                continue
            if name in present and name not in _MAY_REPEAT:
                continue
            families[name] = list(effect.members(self.readings, model.coefficients()))
        return families

    def scores(self, model: ModelFit) -> list[FamilyScore]:
        """Score the whole library against the model, on the readings the model was fitted to."""
        families = {
            name: [
                _on(member, model.used) for member in members if member.event_s is None or self._inside(member, model)
            ]
            for name, members in self._families(model).items()
        }
        return self._judge(model).score({name: members for name, members in families.items() if members})

    def _inside(self, member: Member, model: ModelFit) -> bool:
        starts = cycle_starts(self.readings.subset(model.used))
        return member.event_s is not None and starts[2] <= member.event_s <= starts[-2]

    def _judge(self, model: ModelFit) -> Judge:
        part = self.readings.subset(model.used)
        numbers = np.unique(part.cycle)
        blocks = np.searchsorted(numbers, part.cycle) * _BLOCKS // numbers.size
        return Judge(model.fit, simulate_null(model.fit, self.rng), blocks, part.target_index % 2 == 0)

    def choose(
        self, scores: Sequence[FamilyScore], model: ModelFit, *, level: float = ENTRY_LEVEL
    ) -> FamilyScore | None:
        """Best effect that is significant, confirmed and not blocked, rebuilt for all readings."""
        for score in scores:
            if score.member is None or score.family_wise_p > level or score.held_out_p > CONFIRMATION_LEVEL:
                continue
            part = self.readings.subset(model.used)
            reason = blocked_reason(self.effects[score.name], score.member, part, model, scores)
            if reason is not None:
                self.blocked[score.name] = reason
                continue
            return self._whole(score, model)
        return None

    def _whole(self, score: FamilyScore, model: ModelFit) -> FamilyScore:
        """The same member with its columns for all readings, sealed ones included."""
        wanted = score.member
        for member in self.effects[score.name].members(self.readings, model.coefficients()):
            if wanted is not None and dict(member.parameters) == dict(wanted.parameters):
                return FamilyScore(**{**vars(score), "member": member})
        raise LoopError(
            f"effect {score.name!r} offers other members when asked twice; its members must depend on its input only"
        )


def _on(member: Member, used: NDArray[np.bool_]) -> Member:
    return Member(member.columns[used], member.parameters, member.units, member.event_s)


def _member(score: FamilyScore) -> Member:
    if score.member is None:
        raise LoopError(f"effect {score.name!r} has no member that can be told from the model")
    return score.member


def _re_examine(
    search: _Search, models: list[ModelFit], chosen: Chosen, declared: int
) -> tuple[list[ModelFit], Chosen]:
    """Drop an effect that a later one has made superfluous: its log-likelihood gain beside the others is below 2."""
    model = models[-1]
    for k in range(len(chosen) - 1):
        place = declared + k
        terms = [term for j, term in enumerate(model.terms) if j != place]
        without = refit_fixed(model, terms)
        freedom = model.fit.response.size
        gain = 0.5 * freedom * np.log(without.rss / model.fit.rss)
        if gain < 2.0:
            kept = [pair for j, pair in enumerate(chosen) if j != k]
            return [*models[: k + 1], search.fit(terms, model)], kept
    return models, chosen


def _without_events(search: _Search, models: list[ModelFit], chosen: Chosen) -> tuple[list[ModelFit], Chosen]:
    """Take all events out again: so many of them are a switching without a name."""
    kept = [pair for pair in chosen if pair[0].name != "step_event"]
    search.blocked["step_event"] = (
        f"more than {MOST_EVENTS} events would be needed: that is a switching, for which the library has no name"
    )
    rebuilt = [models[0]]
    for score, _ in kept:
        rebuilt.append(search.fit([*rebuilt[-1].terms, Term(score.name, _member(score))], rebuilt[-1]))
    return rebuilt, kept


def _rmse(errors: Array) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))


def _persistence(readings: Readings, used: NDArray[np.bool_]) -> float:
    """Error of predicting every sealed reading by its site's last reading before the seal, um."""
    site = readings.target_index * 2 + (readings.sign < 0)
    errors = []
    for number in np.unique(site):
        before = np.flatnonzero((site == number) & used)
        after = np.flatnonzero((site == number) & ~used)
        if before.size and after.size:
            errors.append(readings.response[after] - readings.response[before[-1]])
    return _rmse(np.concatenate(errors))


def _coefficients(model: ModelFit, term: Term) -> list[dict[str, float | str]]:
    place = model.place(term)
    values, u = model.fit.coefficients[place], model.fit.coefficients_u[place]
    return [
        {"value": float(value), "u": float(spread), "unit": unit}
        for value, spread, unit in zip(values, u, term.member.units, strict=True)
    ]


def _size(model: ModelFit, term: Term) -> float:
    """Root mean square of a term's contribution after its mean at every site is removed, um."""
    series = model.series(term)[0]
    site = model.readings.target_index * 2 + (model.readings.sign < 0)
    total = np.bincount(site, series, minlength=site.max() + 1)
    number = np.maximum(np.bincount(site, minlength=site.max() + 1), 1)
    return float(np.sqrt(np.mean((series - (total / number)[site]) ** 2)))


def _step(
    model: ModelFit, term: Term, score: FamilyScore, scores: list[FamilyScore], before: float, after: float
) -> Step:
    others = [other for other in scores if other.name != score.name and other.member is not None]
    tied = [other.name for other in others if other.p_value < ENTRY_LEVEL and score.excess - other.excess < TIE_GAIN]
    runner_up: dict[str, float | str] = {}
    if others:
        runner_up = {
            "effect": others[0].name,
            "behind_by": score.excess - others[0].excess,
            "p_value": others[0].family_wise_p,
        }
    way = "on the other half of the targets" if term.member.event_s is not None else "on later blocks of cycles"
    return Step(
        effect=term.effect,
        parameters=term.member.parameters,
        coefficients=_coefficients(model, term),
        p_value=score.family_wise_p,
        held_out_p=score.held_out_p,
        rmse_before_um=before,
        rmse_after_um=after,
        rms_um=_size(model, term),
        tied=tied,
        runner_up=runner_up,
        confirmed=f"{way}, coefficients frozen",
    )


def _second_look(
    search: _Search, whole: ModelFit, steps: list[Step], error: float, rounds: list[list[FamilyScore]]
) -> tuple[ModelFit, list[Step]]:
    """Search once more with the sealed cycles in view: what acted only there could not be found before.

    Coefficients behind the error after still come from the cycles before the seal, but the name does not; the step says so.
    """
    while len(steps) < MOST_EFFECTS:
        scores = search.scores(whole)
        rounds.append(scores)
        best = search.choose(scores, whole, level=SECOND_LEVEL)
        if best is None or _events(steps) + (best.name == "step_event") > MOST_EVENTS:
            return whole, steps
        term = Term(best.name, _member(best))
        whole = fit_model(search.readings, [*whole.terms, term])
        sealed_from = search.readings.seconds[~search.used].min()
        if term.member.event_s is not None and term.member.event_s >= sealed_from - _cycle_length(search.readings):
            after = _late_event_error(search, whole)
            confirmed = "found among the sealed cycles; sized on one half of the targets, tested on the other"
        else:
            after = _rmse(search.fit(whole.terms).open_loop_errors()[0])
            confirmed = "named with the sealed cycles in view, coefficients from the cycles before: the error after is optimistic"
        step = _step(whole, term, best, scores, error, after)
        steps = [*steps, Step(**{**vars(step), "confirmed": confirmed})]
        error = after
    return whole, steps


def _events(steps: Sequence[Step]) -> int:
    return sum(step.effect == "step_event" for step in steps)


def _cycle_length(readings: Readings) -> float:
    return float(np.median(np.diff(cycle_starts(readings))))


def _late_event_error(search: _Search, whole: ModelFit) -> float:
    """Error on the sealed cycles where an event among them is sized on one half of the targets and tested on the other."""
    half = search.readings.target_index % 2 == 0
    parts = [fit_model(search.readings, whole.terms, used=search.used | fitted) for fitted in (half, ~half)]
    return _rmse(np.concatenate([part.open_loop_errors()[0] for part in parts]))


def _nuisance(model: ModelFit) -> dict[str, float | str]:
    """Size of the drift that nobody explains: common part in um, stretch in um at the end of the travel."""
    drift, _ = model.fit.drift()
    kind = "random walk" if model.fit.system.order == 1 else "integrated random walk"
    rate = model.fit.drift_rate
    return {
        "kind": kind,
        "common_rms_um": float(np.std(drift[:, 0])),
        "stretch_rms_um": float(np.std(drift[:, 1])),
        "common_um_per_sqrt_h" if model.fit.system.order == 1 else "common_um_in_1_h": float(rate[0]),
        "stretch_um_per_sqrt_h" if model.fit.system.order == 1 else "stretch_um_in_1_h": float(rate[1]),
    }


__all__ = ["DriftModelError", "LoopError", "LoopResult", "Step", "close_loop"]
