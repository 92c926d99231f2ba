"""The screen *Live*: words, and in a browser a campaign that is followed and stopped by keyboard."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fusion.app.live.screen import LiveScreen, enough_words, standing
from fusion.app.live.session import Course
from fusion.app.state import State
from tests.fusion.app.live.test_session import state_of
from tests.fusion.app.texts import texts


def test_it_says_whether_the_cycles_are_enough() -> None:
    course = Course()
    assert enough_words(course, 0.1) == "Whether the cycles are enough cannot be told yet."
    for number in range(1, 5):
        course.take(state_of(number))
    assert enough_words(course, 0.1) == (
        "The cycles are not enough yet: after 4 of them the standard uncertainty of a position against the first one is 0.25 µm, and 40 "
        "cycles reach 0.1 µm."
    )
    assert "Following: 4 finished cycles, 12 frames, 16 readings." in standing(course, 0.1, runs=True)


def test_a_missing_campaign_and_one_outside_the_folder_are_named(tmp_path: Path) -> None:
    screen = LiveScreen(State(root=tmp_path))
    screen._on_start(None)
    assert "no such campaign file" in texts([screen.view])
    screen._campaign.value = "/etc/passwd"
    screen._on_start(None)
    assert "outside" in texts([screen.view])


@pytest.mark.browser
def test_a_test_is_followed_and_stopped_by_keyboard(app: tuple[str, Path], new_page: Callable[..., Any]) -> None:
    page = new_page(app[0], width=390)
    page.get_by_role("button", name="Live", exact=True).press("Enter")
    page.get_by_role("button", name="Follow", exact=True).press("Enter")
    page.get_by_text("By ISO 230-2, the last five cycles").wait_for(timeout=60_000)
    page.get_by_role("button", name="Stop following").press("Enter")
    page.get_by_text("No longer followed: 24 finished cycles").wait_for(timeout=60_000)
    page.get_by_text("Temperature of the table in cycle").wait_for()
    page.wait_for_function("document.documentElement.scrollWidth <= 390")
