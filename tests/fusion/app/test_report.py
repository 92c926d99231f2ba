"""The report of a run is served in a sandbox; nothing else of the folder is, and nothing outside it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fusion.app.report import report_link


def test_the_report_is_sent_whole_and_in_a_sandbox(app: tuple[str, Path], cookie: str, ask: Callable[..., Any]) -> None:
    address, folder = app
    answer = ask(address, report_link(folder, folder / "results"), Cookie=cookie)
    assert answer.status == 200 and answer.body == (folder / "results" / "report.html").read_bytes()
    policy = answer.headers["Content-Security-Policy"]
    assert policy.startswith("sandbox ") and "allow-same-origin" not in policy and "default-src 'none'" in policy


@pytest.mark.parametrize(
    "path",
    [
        "campaign.toml",
        "results/results.json",
        "linked/report.html",
        "../outside/report.html",
        "%2e%2e/outside/report.html",
        "..%2Foutside/report.html",
        "/etc/passwd",
        "report.html",
        "absent/report.html",
        "%00",
    ],
)
def test_no_other_file_is_sent(app: tuple[str, Path], cookie: str, ask: Callable[..., Any], path: str) -> None:
    answer = ask(app[0], f"/report/{path}", Cookie=cookie)
    assert answer.status == 404 and b"secret" not in answer.body
