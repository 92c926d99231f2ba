"""Causes of an anomaly: each with its name in words and what to inspect on the machine; imports none of the libraries of the diagnosis."""

from __future__ import annotations

from dataclasses import dataclass

from fusion.results.axis import Cause


@dataclass(frozen=True)
class CauseRecord:
    """A cause as a reader meets it.

    Attributes
    ----------
    words : name in words
    check : what to inspect on the machine, or how to repeat the test; one sentence
    """

    words: str
    check: str


CAUSES: dict[Cause, CauseRecord] = {
    "structural": CauseRecord(
        "mechanical scatter",
        "Inspect guideway, scale, screw and nut at this position for preload, wear, contamination and looseness; repeat the "
        "test with small steps around it.",
    ),
    "local_temperature": CauseRecord(
        "local temperature",
        "Find what heats the table near this position (drive, pipe, chips, sun) and whether the fixture bends with it; repeat "
        "the test with that source switched on and off.",
    ),
    "stick_slip": CauseRecord(
        "stick-slip",
        "Inspect lubrication, seals, wipers and the drive's gain at low speed around this position; repeat the test at another "
        "feed rate and after lubrication.",
    ),
    "step": CauseRecord(
        "sudden step",
        "Inspect fixture, optics, clamps and the coupling of the scale, and look for an event at that time in the machine's log.",
    ),
    "link": CauseRecord(
        "jump between two positions",
        "Inspect what carries the motion from the position before to this position: nut and screw (play, preload, a slip), coupling, and "
        "the joints of the scale and of its reading head; repeat the test with small steps between the two.",
    ),
    "undetermined": CauseRecord(
        "undetermined",
        "These data do not decide: repeat the test with more cycles in both directions, a varied duty cycle and a temperature "
        "sensor at this position.",
    ),
}


def undetermined_check(leading: str) -> str:
    """Return what to do where no cause is named, and what to inspect if the leading explanation, unless it is none, holds after all."""
    generic = CAUSES["undetermined"].check
    candidate = None if leading == "undetermined" else CAUSES.get(leading)  # type: ignore[call-overload]
    if candidate is None:
        return generic
    return f"{generic} If the cause is {candidate.words}: {candidate.check[0].lower()}{candidate.check[1:]}"
