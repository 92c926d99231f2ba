"""What a reader learns from the first screen of a report alone: which machine, whether it passes, how sure, why, what next."""

import shutil

import pytest
from playwright.sync_api import sync_playwright

from fusion.pipeline.iso230 import read_test
from fusion.report import findings
from fusion.report.findings import in_brief, sharpen
from fusion.report.page import render_report
from fusion.results.results import assemble, read_results
from interferometry.iso230 import SAMPLING
from tests.browser import CHROMIUM, visible_words
from tests.fusion.campaign_parts import change
from tests.fusion.report.test_campaign import ORIGIN
from tests.fusion.report.test_record import record
from tests.fusion.results_sample import RECORD_LOOP

#: Words that are read in half a minute.
MOST = 165


@pytest.fixture(scope="module")
def reports(stated_results, laser_results, camera_results, picture_results, tmp_path_factory):
    """Reports of a campaign with both instruments, of either one alone, and of a record."""
    runs = {
        "both": stated_results, "laser": laser_results, "camera": camera_results, "pictures": picture_results
    }  # fmt: skip
    pages = {name: run / "report.html" for name, run in runs.items()}
    pages["record"] = tmp_path_factory.mktemp("first") / "record.html"
    results = assemble("Spindle", {"loop": RECORD_LOOP}, [])
    pages["record"].write_text(render_report(results, ORIGIN, {"record": record(drivers=0)}), encoding="utf-8")
    return pages


@pytest.fixture(scope="module")
def opened(reports):
    """Return a function that opens a report in a window of 1400 by 900."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed (Debian: apt-get install chromium)")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])

        def open_page(kind):
            page = browser.new_page(viewport={"width": 1400, "height": 900}, bypass_csp=True)
            page.goto(reports[kind].as_uri())
            page.wait_for_function("document.querySelectorAll('.story canvas, .story .bk-Figure').length > 0")
            return page

        yield open_page
        browser.close()


@pytest.mark.chain
@pytest.mark.parametrize("kind", ["both", "laser", "camera", "pictures", "record"])
def test_the_first_screen_is_a_picture_and_few_words(reports, opened, kind):
    """On a phone the same report shows identity, decision and cause first."""
    page = opened(kind)
    words = visible_words(page)
    print(kind, len(words), " ".join(words))
    assert 20 < len(words) <= MOST, words
    summary, story = page.locator("#summary"), page.locator("#summary .story .chart")
    box = summary.bounding_box()
    assert box["y"] + box["height"] <= 900
    assert story.count() >= 1 and all(story.nth(at).bounding_box()["height"] > 150 for at in range(story.count()))
    assert page.locator("#summary ol.next li").count() in (1, 2, 3)
    assert page.evaluate("document.documentElement.scrollWidth") <= 1400
    told = " ".join(words)
    if kind == "both":
        five_questions_are_answered(told, read_results(reports[kind].parent).iso230)
        page.set_viewport_size({"width": 390, "height": 844})
        on_phone = " ".join(visible_words(page))
        assert "Mill 900" in on_phone and "≤ 20 µm" in on_phone and "a reversal error that changes" in on_phone
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
    if kind == "pictures":
        assert "machine not stated" not in told and "acceptance" not in told and " pictures, emissivity" in told
    page.close()


def five_questions_are_answered(told, part):
    """Which machine, whether it passes, how sure, why, what next."""
    for answer in (
        "Mill 900", "4711", "J. Doe", "X axis", "± ", "a reversal error that changes", "No ISO 230-2 acceptance; unmet:", "Next",
    ):  # fmt: skip
        assert answer in told, answer
    decisions = {row.quantity: row.decision for row in part.tolerances}
    assert set(decisions) == {"A", "B"}
    for symbol, decision in decisions.items():
        said = told.split("No ISO 230-2 acceptance")[0].lower()
        assert f"{symbol.lower()} ≤" in said and decision.split()[0] in said


@pytest.mark.parametrize(
    ("step", "line"),
    [
        ("Check the fan.", "Check the fan."),
        ("Only if the clock is right: look up 10:08 (cycle 38).", "If so: look up 10:08."),
        (
            "Inspect guideway, scale, screw and nut at this position for preload, wear, contamination and looseness; repeat it.",
            "Inspect guideway, scale, screw and nut at this position.",
        ),
        (f"Look {'here and there ' * 5}again.", f"Look {'here and there ' * 4}here …"),
        (
            "Not confirmed, check this only where nothing else is found: look for play in the nut (cold), and measure again.",
            "Unconfirmed: look for play in the nut, and measure again.",
        ),
    ],
)
def test_an_action_is_cut_at_a_clause(step, line):
    assert in_brief(step) == line


@pytest.mark.chain
def test_the_sharper_uncertainty_is_what_the_statement_gives(stated_results, tmp_path):
    """The advice is computed from the budget; the run with the stated line gives the same uncertainty."""
    ran = read_results(stated_results).iso230
    advised = sharpen(ran)
    assert advised.line.startswith('expansion_coefficient = "') and advised.sharper_um < 0.8 * advised.expanded_um
    campaign = shutil.copytree(stated_results.parent / "campaign", tmp_path / "campaign") / "part.toml"
    stated = change(campaign, 'expansion_coefficient = "11.7 ppm/K"', advised.line)
    part = read_test(stated, None).part
    assert 2 * part.A_um.u == pytest.approx(advised.sharper_um, rel=1e-6)
    assert part.A_um.value == ran.A_um.value
    assert next(row.decision for row in part.tolerances if row.quantity == "A") == advised.decision


def test_more_cycles_lessen_the_contributions_of_the_evaluation_that_come_from_scatter() -> None:
    assert findings._OF_SCATTER == SAMPLING
