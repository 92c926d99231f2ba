"""The screen *Run* in a browser: cancelled and resumed by keyboard, seen in two tabs, a wrong file, the report."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fusion.app.run.screen import campaign_of

pytestmark = pytest.mark.browser


def opened(page: Any) -> Any:
    page.get_by_role("button", name="Run", exact=True).first.press("Enter")
    page.get_by_label("Campaign file").wait_for()
    return page


def test_a_run_is_cancelled_resumed_and_reported_by_keyboard_in_two_tabs(
    app: tuple[str, Path], new_page: Callable[..., Any]
) -> None:
    page = opened(new_page(app[0]))
    other = opened(new_page(app[0]))
    for tab in (page, other):
        field = tab.get_by_label("Results folder")
        field.fill("run_here")
        field.press("Tab")
    main = page.locator("main")
    main.get_by_role("button", name="Run", exact=True).press("Enter")
    other.get_by_text("under way; this page may be closed").wait_for()
    page.get_by_text("reading and checking").wait_for()
    again = opened(new_page(app[0]))
    again.get_by_text("under way; this page may be closed").wait_for()
    assert again.get_by_label("Results folder").input_value() == str(app[1] / "run_here"), (
        "a page opened again shows it"
    )
    other.get_by_role("button", name="Cancel").press("Enter")
    for tab in (page, other):
        tab.get_by_text("The run was cancelled").wait_for()
    resume = main.get_by_role("button", name="Run", exact=True).or_(main.get_by_role("button", name="Resume"))
    resume.press("Enter")
    page.get_by_text("The run is finished.").wait_for(timeout=240_000)
    with page.context.expect_page() as opening:
        page.get_by_role("link", name="Open the report").press("Enter")
    report = opening.value
    report.get_by_role("heading", level=1, name="Small campaign").wait_for()
    assert "/report/run_here/report.html" in report.url
    assert report.evaluate("self.origin") == "null", "its scripts are cut off from the application"


def test_a_wrong_file_and_a_path_outside_say_what_to_do(app: tuple[str, Path], new_page: Callable[..., Any]) -> None:
    page = opened(new_page(app[0]))
    (app[1] / "wrong.toml").write_text('[campaign]\ntitle = "<b>"\ncolour = "red"\n')
    for written, told in (
        ("wrong.toml", "colour"),
        ("absent.toml", "no such file"),
        ("../outside/x.toml", "lies outside"),
    ):
        page.get_by_label("Campaign file").fill(written)
        page.get_by_label("Results folder").fill("wrong_results")
        page.get_by_label("Results folder").press("Tab")
        page.locator("main").get_by_role("button", name="Run", exact=True).press("Enter")
        page.get_by_role("alert").filter(has_text=told).first.wait_for()
    assert not (app[1] / "wrong_results").exists()


def test_results_of_another_campaign_are_not_replaced(app: tuple[str, Path], new_page: Callable[..., Any]) -> None:
    page = opened(new_page(app[0]))
    (app[1] / "below").mkdir()
    shutil.copy(app[1] / "campaign.toml", app[1] / "below")
    kept = shutil.copytree(app[1] / "results", app[1] / "kept")
    provenance = json.loads((kept / "provenance.json").read_text(encoding="utf-8"))
    (kept / "provenance.json").write_text(json.dumps(provenance | {"campaign_file": "../campaign.toml"}))
    assert campaign_of(kept) == (app[1] / "campaign.toml").resolve() and campaign_of(app[1]) is None
    page.get_by_label("Campaign file").fill("below/campaign.toml")
    page.get_by_label("Results folder").fill("kept")
    page.get_by_label("Results folder").press("Tab")
    page.get_by_role("button", name="Run again").press("Enter")
    page.get_by_role("alert").filter(has_text="name another results folder, they would be replaced").wait_for()
