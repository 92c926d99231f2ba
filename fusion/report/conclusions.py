"""Conclusions of a run as answers to a reader's questions: why, how much, where, how sure, which place, what remains."""

from __future__ import annotations

from typing import NamedTuple

from fusion.report.wording import conditional, randomised_causes, say
from fusion.results.axis import AnomalyPart
from fusion.results.loop import StepPart
from fusion.results.parts import TimePart
from fusion.results.results import Results

#: Question of a reader, and the statement that answers it.
_QUESTIONS = {
    "How much": "how_much",
    "Where": "where",
    "How sure": "how_sure",
    "Which place": "which_place",
    "What remains": "what_remains",
}


class Conclusion(NamedTuple):
    """One conclusion of a run: the question that it answers, and sentences."""

    question: str
    text: str


def conclude(results: Results) -> list[Conclusion]:
    """Return the conclusions of a run in the order of a reader's questions; those that the run does not answer are absent."""
    answers = [Conclusion(question, say(statement, results)) for question, statement in _QUESTIONS.items()]
    return [answer for answer in answers if answer.text]


def headline(results: Results) -> str:
    """Return one sentence that states the outcome, conditional where an input is doubted."""
    return say("headline", results)


def describe_anomaly(anomaly: AnomalyPart) -> str:
    """Return one sentence on a position that stands out: what it does, by how much, and what that speaks for."""
    return say("anomaly_sentence", anomaly)


def position_words(target: int, position_mm: float | None) -> str:
    """Return the name of a target position with its place."""
    return say("position_words", target, position_mm)


# Added effects in words: what each is, and what to check.


def step_phrase(step: StepPart, time: TimePart | None, *, record: bool) -> str:
    """Return an added effect with what it follows, or when it happened."""
    return say("step_phrase", step, time, record)


def action(step: StepPart, time: TimePart | None, *, record: bool) -> str:
    """Return what to check on machine or instruments where an effect was missing; empty where the effect states nothing."""
    return say("action", step, time, record)


# What to do next, in the order of importance; every action names the place, the time or the part that it is about.


def _clock_doubted(results: Results) -> bool:
    """Whether a clock is doubted: what remains may then be its doing."""
    doubts = results.inputs.doubts if results.inputs else ()
    return any(check.code == "clocks" or check.code.endswith("_clock") for check in doubts)


def next_steps(results: Results) -> list[str]:
    """Return what to do next: doubted inputs, what the loop found, positions that stand out, the place, remedies of the warnings."""
    inputs = results.inputs
    steps = [check.remedy for check in (*inputs.doubts, *inputs.unverified)] if inputs else []
    loop, correlation = results.loop, results.correlation
    if loop is not None:
        # Where no cause is separable, none is to be looked for.
        shown = loop.steps if loop.separable else ()
        actions = [action(step, results.time, record=results.registration is None) for step in shown]
        steps += [conditional(one, inputs, "causes") for one in actions]
        if loop.verdict in {"partial", "unexplained", "no_skill"} and loop.separable and not _clock_doubted(results):
            steps.append(say("log_more", loop.unexplained.shape))
    steps += [
        f"{position_words(anomaly.target, anomaly.position_mm)}: {anomaly.evidence.check}"
        for anomaly in results.anomalies or ()
    ]
    if correlation is not None and correlation.verdict == "attributable" and not randomised_causes(correlation):
        steps.append(say("test_place", correlation.source))
    steps += [warning.remedy for warning in results.warnings]
    unique = list(dict.fromkeys(step for step in steps if step))
    values = "profile" if results.drift else "values by ISO 230-2" if results.iso230 else "temperatures"
    return unique or [f"Nothing has to be done: use the {values} with the stated uncertainty as they are."]
