"""Two sessions in words: which is which, who shows what, and no verdict that contradicts another."""

from __future__ import annotations

from dataclasses import replace

import xarray as xr

from fusion.attribution.two_sessions import ChannelAgreement, SessionComparison, SourceAgreement
from fusion.products.results import assemble
from fusion.report.joint_page import (
    channel_sentence,
    conclude_sessions,
    describe_sources,
    render_joint,
    session_names,
    sources_table,
)
from tests.fusion.results_sample import PARTS

RESULTS = [assemble(title, PARTS, []) for title in ("Monday <1>", "Tuesday")]
SESSIONS = session_names(RESULTS)
ALONE = SourceAgreement(
    "joint",
    405.0,
    95.0,
    (0,),
    (0.002, 0.006),
    (3.76, 7.8),
    (0.08, 0.85),
    (0.0, 600.0),
    False,
    True,
    0.97,
    (330.0, 90.0, 75.2),
)
AGREED = SourceAgreement(
    "joint", 330.0, 90.0, (0, 1), (0.004, 0.004), (4.04, 5.75), (0.5, 0.6), (0.0, 0.0), True, False
)
CHANNEL = ChannelAgreement(
    "joint", "attributable", 330.0, 90.0, 0.004, (4.04, 5.75), (0.0, 0.0), "both sessions find this place"
)


def compared(*sources: SourceAgreement) -> SessionComparison:
    return SessionComparison(xr.Dataset(), [CHANNEL], list(sources))


def test_a_neighbouring_place_is_told_apart_and_reconciled() -> None:
    both = compared(ALONE, AGREED)
    first, second = describe_sources(both, SESSIONS)
    assert (first.name, second.name) == ("place 1", "place 2")
    assert first.verdict.startswith(
        "shown by A (Monday <1>) alone; B (Tuesday) shows something there too, but not the same: 3.8 and 7.8"
    )
    assert "75 mm beside it both agree (place 2)" in first.verdict
    assert second.verdict.startswith("both sessions agree here, but it is no source of its own")
    told = conclude_sessions(both, [first, second], SESSIONS)
    assert told[0] == "The two sessions show no cause together."
    assert (
        told[1].startswith("Both agree in place 2 (x 330 mm, y 90 mm")
        and told[2] == "A (Monday <1>) alone shows place 1."
    )


def test_what_one_session_shows_alone_has_the_chance_of_the_other() -> None:
    missed = replace(ALONE, p_value=(0.002, 0.6), agreed_near_mm=None, shown_by=(0,), power=0.31)
    (one,) = describe_sources(compared(missed), SESSIONS)
    assert (
        one.verdict == "shown by A (Monday <1>) alone; B (Tuesday) would have shown the same size with a chance of 31 %"
    )
    assert one.shown[1] == "p 0.6, 7.8 ± 1.7 µm/K, lag 10 min"


def test_a_cause_is_what_both_show() -> None:
    cause = replace(AGREED, separate=True)
    both = compared(cause)
    words = describe_sources(both, SESSIONS)
    assert words[0].verdict.startswith("a cause: both sessions agree")
    assert conclude_sessions(both, words, SESSIONS)[0].startswith("Both sessions show the same cause: place 1")
    assert channel_sentence(CHANNEL).endswith("larger p of both 0.004, 4.0 and 5.8 µm/K")


def test_without_a_source_that_is_said() -> None:
    nothing = compared()
    assert sources_table([], SESSIONS) is None
    assert conclude_sessions(nothing, [], SESSIONS)[0].startswith("Neither session shows a source")


def test_the_page_escapes_titles_and_links_both_reports() -> None:
    page = render_joint(RESULTS, ["monday", "tuesday"], compared(ALONE, AGREED))
    assert "Monday &lt;1&gt;" in page and "<1>" not in page
    assert 'href="monday/report.html"' in page and 'href="tuesday/report.html"' in page
    assert "The two sessions show no cause together." in page
