"""The page in a browser: its bar of screens, the keyboard, two tabs, a phone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fusion.app.page import SCREENS

pytestmark = pytest.mark.browser


def test_the_address_opens_the_first_screen_and_the_token_leaves_the_address(
    app: tuple[str, Path], new_page: Callable[..., Any]
) -> None:
    page = new_page(app[0])
    assert page.title() == "thermofuse" and "token" not in page.url
    page.get_by_role("heading", name=next(iter(SCREENS)), exact=True).wait_for()
    for name in SCREENS:
        assert page.get_by_role("button", name=name, exact=True).count() == 1
    other = page.context.new_page()
    other.goto(page.url)
    other.get_by_role("heading", name=next(iter(SCREENS)), exact=True).wait_for()


def test_a_phone_shows_it_without_scrolling_sideways(app: tuple[str, Path], new_page: Callable[..., Any]) -> None:
    page = new_page(app[0], width=390)
    page.get_by_role("heading", name=next(iter(SCREENS)), exact=True).wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_screen_breaks_a_serious_rule_of_accessibility(
    app: tuple[str, Path], new_page: Callable[..., Any], scheme: str
) -> None:
    from axe_playwright_python.sync_playwright import Axe

    page = new_page(app[0], width=390, bypass_csp=True, color_scheme=scheme)
    page.get_by_text("12 fiducials agree").wait_for()
    page.get_by_role("slider", name="Camera clock minus laser clock (s)").wait_for()
    for name in ("Set up", "Run"):
        page.get_by_role("button", name=name, exact=True).first.press("Enter")
        page.get_by_role("heading", name=name, exact=True).wait_for()
        found = Axe().run(page).response["violations"]
        assert not [(one["id"], one["nodes"][0]["html"]) for one in found if one["impact"] in ("serious", "critical")]
