"""Causes of an anomaly: every one has its words and what to inspect."""

from __future__ import annotations

from fusion.diagnosis.causes import CAUSES, undetermined_check
from fusion.products.results import CAUSES as NAMES


def test_every_cause_has_words_and_a_sentence_of_what_to_inspect() -> None:
    assert tuple(CAUSES) == NAMES
    assert len({record.words for record in CAUSES.values()}) == len(CAUSES)
    for record in CAUSES.values():
        assert record.words == record.words.lower() and not record.words.endswith(".")
        assert record.check[0].isupper() and record.check.endswith(".")


def test_without_a_cause_the_test_is_repeated_and_the_leading_explanation_is_looked_at() -> None:
    generic = CAUSES["undetermined"].check
    assert undetermined_check("step") == (
        f"{generic} If the cause is sudden step: inspect fixture, optics, clamps and the coupling of the scale, "
        "and look for an event at that time in the machine's log."
    )
    assert all(
        CAUSES[name].words in undetermined_check(name) for name in ("structural", "local_temperature", "stick_slip")
    )
    # A random walk is no cause, and nor is "undetermined".
    assert undetermined_check("slow") == undetermined_check("undetermined") == generic
