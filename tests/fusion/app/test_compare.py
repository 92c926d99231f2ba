"""The screen *Compare*: its charts, what is offered, and in a browser what it says."""

import asyncio
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fusion.app.compare import (
    CompareScreen,
    find_results,
    label_of,
)
from fusion.app.parts import State
from fusion.pipeline.compare import compare_campaigns
from fusion.report.charts.comparison import plot_profiles, plot_remaining, plot_scatters
from fusion.results.store import write_json
from tests.fusion.app.texts import texts
from tests.fusion.compared_tests import readings_of, repaired, write_results


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compared")
    before = write_results(folder / "before", readings_of(31))
    (found,) = compare_campaigns([before, write_results(folder / "after", repaired(readings_of(33), -1.2))])
    return found


def test_charts_show_profiles_what_remains_and_scatter(pair):
    chart = plot_profiles([pair.before, pair.after], ["A", "B"])
    assert [abs(float(np.mean(chart.columns[f"deviation, {name} / µm"]))) < 1e-9 for name in "AB"] == [True, True]
    assert chart.seen.startswith("Profiles about their means: A ")
    chart = plot_remaining(pair)
    assert chart.seen.endswith("changed: 80 mm.")
    assert plot_remaining(replace(pair, profile=None)) is None
    bare = replace(pair.after, drift=None)
    chart = plot_scatters([pair.before, bare], ["A", "B"])
    assert "B" not in chart.seen and chart.figure.y_range.start == 0.0
    assert plot_scatters([bare], ["B"]) is None and plot_profiles([bare], ["B"]) is None


def test_results_are_found_below_a_folder_and_no_others(tmp_path):
    for name in ("b/results", "a", "a/deeper", ".hidden", "1/2/3/4/5"):
        (tmp_path / name).mkdir(parents=True)
        for file in ("results.json", "provenance.json"):
            (tmp_path / name / file).write_text("{}")
    (tmp_path / "linked").symlink_to(tmp_path / "b")
    found, whole = find_results(tmp_path)
    assert [folder.relative_to(tmp_path).as_posix() for folder in found] == ["a", "b/results"]
    assert whole
    assert label_of(tmp_path, tmp_path / "a") == "a (cannot be read)"


def test_results_that_cannot_be_opened_or_were_edited_are_listed_as_such(tmp_path, monkeypatch):
    screen = two_results(tmp_path)
    later = tmp_path / "later"
    write_json(later / "provenance.json", {"products": {"results.json": {"bytes": 1, "sha256": "of another file"}}})
    screen._list()
    assert [label for label in screen._labels if "(cannot be read)" in label] == ["later (cannot be read)"]

    def locked(path, *how, **options):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", locked)
    screen._list()
    assert list(screen._labels) == ["before (cannot be read)", "later (cannot be read)"]


def test_with_fewer_than_two_results_nothing_is_compared(tmp_path):
    screen = CompareScreen(State(root=tmp_path))
    assert "There is no results folder of a finished run" in texts([screen.view])
    assert screen._compare.disabled


def two_results(folder):
    """The screen before two results folders, one of which is ticked."""
    for name, seed in (("before", 31), ("later", 32)):
        write_results(folder / name, readings_of(seed))
    screen = CompareScreen(State(root=folder))
    screen._others.value = [folder / "later"]
    return screen


def raising(error):
    def fail(*args, **options):
        raise error

    return fail


def test_a_product_that_may_not_be_read_is_told_and_the_button_comes_back_whatever_fails(tmp_path, monkeypatch):
    screen, denied = two_results(tmp_path), "[Errno 13] Permission denied: '/results/deviations.nc'"
    monkeypatch.setattr("fusion.app.compare.compare_campaigns", raising(PermissionError(denied)))
    asyncio.run(screen._show(None))
    assert denied in texts([screen.view])
    assert not screen._compare.disabled
    monkeypatch.setattr("fusion.app.compare.compare_campaigns", raising(ZeroDivisionError()))
    monkeypatch.chdir(tmp_path)  # the report of the fault
    asyncio.run(screen._show(None))
    assert "ZeroDivisionError in" in texts([screen.view])
    assert not screen._compare.disabled


def test_two_campaigns_are_chosen_and_compared_by_keyboard(app, new_page):
    shutil.copytree(app[1] / "results", app[1] / "later")
    page = new_page(app[0], width=390)
    page.get_by_role("button", name="Compare", exact=True).first.press("Enter")
    page.get_by_label("Reference").select_option("results: Small campaign, 2026-03-09")
    page.get_by_role("checkbox", name="results: Small campaign").wait_for(state="detached")
    box = page.get_by_role("checkbox", name="later: Small campaign")
    box.focus()
    page.keyboard.press("Space")
    page.get_by_role("button", name="Compare", exact=True).last.press("Enter")
    compared = page.frame_locator("iframe[title=Comparison]")
    compared.get_by_text("No change of the machine is shown").first.wait_for()
    page.wait_for_function("document.documentElement.scrollWidth <= 390")
