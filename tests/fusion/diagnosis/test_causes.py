"""Causes of an anomaly: every one has its words and what to inspect."""

from __future__ import annotations

from fusion.diagnosis.causes import CAUSES
from fusion.products.results import CAUSES as NAMES


def test_every_cause_has_words_and_a_sentence_of_what_to_inspect() -> None:
    assert tuple(CAUSES) == NAMES
    assert len({record.words for record in CAUSES.values()}) == len(CAUSES)
    for record in CAUSES.values():
        assert record.words == record.words.lower() and not record.words.endswith(".")
        assert record.check[0].isupper() and record.check.endswith(".")
