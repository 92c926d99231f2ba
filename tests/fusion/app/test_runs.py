"""Runs of the application: what a page opens with, progress, a run that is cancelled, and the screen *Run* in a browser."""

import json
import shutil
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from fusion.app.parts import state_of
from fusion.app.runs import RUNS, Progress, RunError, Runs, is_begun
from fusion.common.messages import ExitCode
from fusion.pipeline.resume import noted_campaign
from fusion.results.progress import write_lines

pytestmark = pytest.mark.long


def test_a_page_opens_with_what_lies_in_its_folder(tmp_path):
    state = state_of(tmp_path)
    folder = tmp_path.resolve()
    assert (state.root, state.folder, state.campaign, state.results) == (folder, folder, None, None)
    (tmp_path / "campaign.toml").touch()
    (tmp_path / "results").mkdir()
    assert state_of(tmp_path).results is None, "a folder without results.json holds no finished run"
    (tmp_path / "results" / "results.json").touch()
    state = state_of(tmp_path)
    assert (state.campaign, state.results) == (tmp_path / "campaign.toml", tmp_path / "results")
    with pytest.raises(TypeError, match=r"[Cc]onstant"):
        state_of(tmp_path).root = Path("/")


def test_a_page_opens_with_the_run_that_was_started_last(tmp_path, monkeypatch):
    campaign, results = tmp_path / "below" / "campaign.toml", tmp_path / "elsewhere"
    campaign.parent.mkdir()
    campaign.touch()
    monkeypatch.setattr(RUNS, "_runs", {results: SimpleNamespace(campaign=campaign, results=results)})
    state = state_of(tmp_path)
    assert (state.folder, state.campaign, state.results) == (campaign.parent, campaign, None)
    results.mkdir()
    (results / "results.json").touch()
    assert state_of(tmp_path).results == results


@pytest.fixture
def runs():
    made = Runs()
    yield made
    made.end()


@pytest.mark.chain
def test_a_run_is_cancelled_cleanly_and_holds_its_folder_until_then(campaign_folder, tmp_path, runs):
    results = tmp_path / "results"
    run = runs.start(campaign_folder / "campaign.toml", results)
    assert run.runs and runs.of(results) is run and not run.resumed
    with pytest.raises(RunError, match="is in use by a run of another page"):
        runs.start(campaign_folder / "campaign.toml", results)
    end = time.monotonic() + 30
    while not run.progress.stages and time.monotonic() < end:
        time.sleep(0.05)
    run.cancel()
    assert run.wait(30) == ExitCode.TERMINATED
    assert any("stopped by SIGTERM" in message for message in run.messages)


def test_bad_input_is_told_in_the_words_of_the_command(tmp_path, runs):
    (tmp_path / "campaign.toml").write_text("[campaign]\naxis = 'X'\n")
    run = runs.start(tmp_path / "campaign.toml", tmp_path / "results")
    assert run.wait(30) == ExitCode.BAD_INPUT
    assert "campaign.toml" in run.messages[0] and not run.messages[0].startswith("thermofuse")
    assert not (tmp_path / "results").exists()


def test_a_folder_with_anything_in_it_is_begun(tmp_path):
    assert not is_begun(tmp_path / "absent") and not is_begun(tmp_path)
    (tmp_path / "x").touch()
    assert is_begun(tmp_path)


def test_a_step_tells_how_far_it_is_and_counts_anew_when_it_begins_again():
    progress = Progress()
    progress.take("frames", 0, 60, 100.0)
    assert progress.stages["frames"].words == "under way"
    progress.take("frames", 1, 60, 112.0)
    assert progress.stages["frames"].words == "1 of 60", "the first part waits for all that has to start"
    progress.take("frames", 15, 60, 119.0)
    assert progress.stages["frames"].share == 0.25
    assert progress.stages["frames"].words == "15 of 60, about 22 s left"
    progress.take("frames", 60, 60, 140.0)
    assert progress.stages["frames"].words == "done in 40 s"
    progress = Progress()
    progress.take("loop", 5, 5, 10.0)
    progress.take("loop", 0, 5, 20.0)
    progress.take("loop", 1, 5, 21.0)
    progress.take("loop", 2, 5, 22.0)
    assert progress.stages["loop"].words == "2 of 5, about 3 s left"
    progress.take("maps", 0, 0, 30.0)
    assert progress.stages["maps"].words == "done"
    assert list(progress.stages) == ["loop", "maps"]


def test_progress_is_one_object_per_line(capsys):
    write_lines('a "step"', 1, 3)
    assert [json.loads(line) for line in capsys.readouterr().out.splitlines()] == [
        {"label": 'a "step"', "done": 1, "total": 3}
    ]


def opened(page):
    page.get_by_role("button", name="Run", exact=True).first.press("Enter")
    page.get_by_label("Campaign file").wait_for()
    return page


@pytest.mark.slow
def test_a_run_is_cancelled_resumed_and_reported_by_keyboard_in_two_tabs(app, new_page):
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


def test_a_wrong_file_and_a_path_outside_say_what_to_do(app, new_page):
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


def test_results_of_another_campaign_are_not_replaced(app, new_page):
    page = opened(new_page(app[0]))
    (app[1] / "below").mkdir()
    shutil.copy(app[1] / "campaign.toml", app[1] / "below")
    kept = shutil.copytree(app[1] / "results", app[1] / "kept")
    provenance = json.loads((kept / "provenance.json").read_text(encoding="utf-8"))
    (kept / "provenance.json").write_text(json.dumps(provenance | {"campaign_file": "../campaign.toml"}))
    assert noted_campaign(kept) == (app[1] / "campaign.toml").resolve() and noted_campaign(app[1]) is None
    page.get_by_label("Campaign file").fill("below/campaign.toml")
    page.get_by_label("Results folder").fill("kept")
    page.get_by_label("Results folder").press("Tab")
    page.get_by_role("button", name="Run again").press("Enter")
    page.get_by_role("alert").filter(has_text="name another results folder, they would be replaced").wait_for()
