"""What may be said: a name is confirmed by an error that falls by more than chance, and the outcome has one word."""

from __future__ import annotations

import pytest

from fusion.loop.verdict import GAIN_SHARE, doubt_of, exceeds_noise, has_skill, is_confirmed, verdict


@pytest.mark.parametrize(
    ("with_um", "without_um", "noise_um", "confirmed"),
    [
        (0.9, 1.0, 0.0, True),
        (10.846, 10.855, 0.0, False),  # a thousandth of the error
        (1.01, 1.0, 0.0, False),
        (0.402, 0.41, 0.4, True),  # most of what is left beside the noise
        (0.3, 0.35, 0.4, True),  # an error below the noise is all chance, and smaller all the same
        (1.0, 1.0, 0.0, False),
    ],
)
def test_an_effect_is_confirmed_by_a_share_of_the_error_beyond_the_noise(with_um, without_um, noise_um, confirmed):
    assert is_confirmed(with_um, without_um, noise_um) is confirmed
    assert (doubt_of(with_um, without_um, noise_um, "on the hold-out set") == "") is confirmed


def test_the_share_is_two_percent_of_an_error_without_noise():
    assert is_confirmed((1.0 - GAIN_SHARE) ** 0.5 - 1e-9, 1.0, 0.0)
    assert not is_confirmed((1.0 - GAIN_SHARE) ** 0.5 + 1e-9, 1.0, 0.0)
    assert pytest.approx(0.98, abs=3e-4) == (1.0 - GAIN_SHARE) ** 0.5


def test_a_doubt_names_both_errors():
    assert doubt_of(1.94, 1.9, 0.4, "on the hold-out set") == (
        "the error on the hold-out set is 1.9 µm without it and 1.94 µm with it"
    )


@pytest.mark.parametrize(("error_um", "exceeds"), [(0.44, False), (0.45, True)])
def test_an_error_exceeds_the_noise_by_what_is_left_beside_it(error_um, exceeds):
    """With half the noise beside it 0.4 um become 0.447 um."""
    assert exceeds_noise(error_um, 0.4, 0.5) is exceeds


@pytest.mark.parametrize(
    ("error_um", "last_um", "mean_um", "skill"),
    [(1.0, 2.0, 3.0, True), (1.0, 0.9, 3.0, False), (1.0, 3.0, 0.9, False), (0.42, 0.41, 0.41, True)],
)
def test_skill_is_more_than_the_last_value_or_the_mean_or_an_error_of_noise_alone(error_um, last_um, mean_um, skill):
    assert has_skill(error_um, last_um, mean_um, 0.4, 0.5) is skill


SOUND = {"confirmed": False, "doubtful": False, "tested": False, "remains": False, "skill": True}


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({}, "complete"),
        ({"confirmed": True}, "explained"),
        ({"remains": True}, "unexplained"),
        ({"tested": True}, "unexplained"),
        ({"doubtful": True}, "unexplained"),
        ({"confirmed": True, "remains": True}, "partial"),
        ({"confirmed": True, "tested": True}, "partial"),
        ({"confirmed": True, "doubtful": True}, "partial"),
        ({"skill": False}, "no_skill"),
        ({"skill": False, "confirmed": True}, "no_skill"),
        ({"skill": False, "remains": True}, "no_skill"),
        ({"skill": False, "doubtful": True}, "no_skill"),
        ({"skill": False, "tested": True}, "unexplained"),
        ({"skill": False, "tested": True, "confirmed": True}, "partial"),
    ],
)
def test_the_outcome_has_one_word(changed, word):
    assert verdict(**{**SOUND, **changed}) == word
