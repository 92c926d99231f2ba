"""Questions: defaults where nothing is asked, again where an answer cannot be used."""

from __future__ import annotations

import pytest

from fusion.campaign.quantities import QuantityError
from fusion.starting.questions import Asker


def test_nothing_is_asked_without_a_terminal() -> None:
    silent = Asker(None)
    assert silent.text("Title", "A") == "A"
    assert silent.quantity("Width", "mm", "5 mm") == '"5 mm"'
    assert silent.quantity("Width", "mm") == '"FILL IN"'
    assert silent.choice("Which", ("a", "b")) == "a"
    with pytest.raises(QuantityError):
        silent.quantity("Width", "mm", "5")


def test_an_answer_that_cannot_be_used_is_asked_again() -> None:
    answers, told = iter(["5", "5 K", "5 mm", "c", "b"]), []
    asker = Asker(lambda question, default: next(answers), told.append)
    assert asker.quantity("Width", "mm") == '"5 mm"'
    assert asker.choice("Which", ("a", "b")) == "b"
    assert len(told) == 3 and "needs its unit" in told[0] and told[2] == '"c" is none of them'


def test_an_empty_answer_leaves_the_line_to_fill_in() -> None:
    assert Asker(lambda question, default: "").quantity("Width", "mm") == '"FILL IN"'
