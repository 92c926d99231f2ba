"""The page of a fleet shows every campaign, leads to its report, and runs nothing that a file holds."""

from fusion.fleet.page import render_fleet
from fusion.fleet.summary import Row

STARTED = "2026-11-22T01:30:00+00:00"
WHOLE = Row(
    "hall 1/<X>", "finished", 0, "<script>alert(1)</script>", "partial", drift_um=12.3, drift_u_um=0.4, anomalies=2,
    warnings=3, inputs="doubted",
)  # fmt: skip
FAILED = Row("m/Y", "failed", 2, message="laser.csv, line 3: <img src=x>", log="logs/m_Y.log")


def test_everything_from_a_file_is_escaped():
    page = render_fleet([WHOLE, FAILED], started=STARTED)
    assert "<script>alert" not in page and "<img" not in page
    assert "&lt;script&gt;alert(1)" in page
    assert 'href="hall%201/%3CX%3E/report.html"' in page


def test_failures_come_first_with_reason_and_log():
    page = render_fleet([WHOLE, FAILED], started=STARTED)
    assert page.index("laser.csv, line 3") < page.index("<h2>Campaigns</h2>")
    assert 'href="logs/m_Y.log"' in page
    assert "2 campaigns: 1 finished, 1 failed. Started 2026-11-22 01:30 UTC." in page
    assert "12.30 ± 0.80 µm" in page
    assert "What failed" not in render_fleet([WHOLE], started=STARTED)
