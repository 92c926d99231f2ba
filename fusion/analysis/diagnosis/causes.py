"""Causes of an anomaly: each with its name in words and what to inspect on the machine; imports none of the libraries of the diagnosis."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from thermofuse.resources import sentence, vocabulary


@dataclass(frozen=True)
class CauseRecord:
    """A cause as a reader meets it: its name in words, and in one sentence what to inspect on the machine, or how to repeat the test."""

    words: str
    check: str


#: Return a sentence of the evidence for or against a cause.
say = partial(sentence, "diagnosis", "evidence")
CAUSES = {name: CauseRecord(**words) for name, words in vocabulary("diagnosis")["causes"].items()}


def undetermined_check(leading: str) -> str:
    """Return what to do where no cause is named, and what to inspect if the leading explanation, unless it is none, holds after all."""
    generic = CAUSES["undetermined"].check
    candidate = None if leading == "undetermined" else CAUSES.get(leading)
    if candidate is None:
        return generic
    return f"{generic} If the cause is {candidate.words}: {candidate.check[0].lower()}{candidate.check[1:]}"
