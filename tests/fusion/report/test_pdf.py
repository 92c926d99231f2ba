"""The report on paper: whole, on A4, with page numbers; and clear words where no browser can print."""

from __future__ import annotations

import re
import shutil
import stat
from pathlib import Path

import pytest

from fusion.report import pdf
from fusion.report.html import report_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def test_the_browser_that_is_named_must_exist() -> None:
    with pytest.raises(pdf.PrintError, match='--browser "no-such-browser": there is no such program'):
        pdf.find_browser("no-such-browser")


def test_without_a_browser_the_remedy_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(pdf.PrintError, match=r"no browser that can print was found .* press its button Print"):
        pdf.find_browser()


def test_a_browser_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    broken = tmp_path / "browser"
    broken.write_text("#!/bin/sh\necho cannot open display >&2\nexit 3\n")
    broken.chmod(broken.stat().st_mode | stat.S_IXUSR)
    out = tmp_path / "report.pdf"
    out.write_bytes(b"old")
    with pytest.raises(pdf.PrintError, match="ended with 3 and printed nothing: cannot open display"):
        pdf.print_pdf("<p>page</p>", out, browser=str(broken))
    assert out.read_bytes() == b"old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["browser", "report.pdf"]


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed (Debian: apt-get install chromium)")
def test_the_report_is_printed_on_a4_with_its_charts(results_folder: Path, tmp_path: Path) -> None:
    written = pdf.print_pdf(report_of(results_folder), tmp_path / "report.pdf", browser=CHROMIUM)
    content = written.read_bytes()
    assert content.startswith(b"%PDF")
    boxes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", content)
    assert {(round(float(width)), round(float(height))) for width, height in boxes} == {(595, 842)}
    assert 6 <= len(re.findall(rb"/Type /Page\b", content)) <= 20
    assert len(content) > 300_000  # charts are drawings in it, not blank places
