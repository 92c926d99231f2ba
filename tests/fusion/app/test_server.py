"""The running server: what it refuses, what it sends with every answer, and what it says when it cannot start."""

from __future__ import annotations

import importlib.util
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from typer.testing import CliRunner

from fusion.app.places import PlaceError
from fusion.app.server import MissingExtraError, serve
from fusion.cli import app as command

#: What opens the page, its connection, its scripts, and the data.
PATHS = (
    "/",
    "/ws",
    "/static/js/bokeh.min.js",
    "/static/extensions/panel/panel.min.js",
    "/report/results/report.html",
    "/none",
)


def test_the_token_becomes_a_cookie_that_scripts_and_other_sites_do_not_get(
    app: tuple[str, Path], ask: Callable[..., Any]
) -> None:
    answer = ask(app[0], f"/?{urlsplit(app[0]).query}")
    assert answer.status == 302 and answer.headers["Location"] == "/"
    assert "HttpOnly" in answer.headers["Set-Cookie"] and "SameSite=Strict" in answer.headers["Set-Cookie"]


@pytest.mark.parametrize("path", PATHS)
def test_a_stranger_gets_403_everywhere(app: tuple[str, Path], ask: Callable[..., Any], path: str) -> None:
    for query in ("", "?token=", "?token=x", "?token=%FF"):
        answer = ask(app[0], path + query)
        assert answer.status == 403 and b"open that one first" in answer.body
    assert ask(app[0], path, Upgrade="websocket", Connection="Upgrade", Origin=app[0].split("/?")[0]).status == 403


@pytest.mark.parametrize("path", PATHS)
def test_another_site_and_another_name_get_nothing(
    app: tuple[str, Path], cookie: str, ask: Callable[..., Any], path: str
) -> None:
    for method in ("GET", "POST"):
        assert ask(app[0], path, method=method, Cookie=cookie, Origin="http://evil.example").status == 403
        assert ask(app[0], path, method=method, Cookie=cookie, Host="evil.example").status == 403
    token = urlsplit(app[0]).query
    assert "Set-Cookie" not in ask(app[0], f"{path}?{token}", Host="evil.example").headers


def test_every_answer_says_what_a_browser_may_do_with_it(
    app: tuple[str, Path], cookie: str, ask: Callable[..., Any]
) -> None:
    for answer in (ask(app[0], "/"), ask(app[0], "/", Cookie=cookie), ask(app[0], "/none", Cookie=cookie)):
        policy = answer.headers["Content-Security-Policy"]
        assert (
            "default-src 'self'" in policy
            and "script-src 'self' 'nonce-" in policy
            and "script-src 'self' 'unsafe-inline'" not in policy
        )
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"


def test_the_page_names_no_other_host(app: tuple[str, Path], cookie: str, ask: Callable[..., Any]) -> None:
    page = ask(app[0], "/", Cookie=cookie).body.decode()
    assert "https://" not in page and "http://" not in page
    assert cookie.split("=")[1] not in page, "a script of the page cannot learn the cookie"


def test_it_listens_on_this_machine_only(app: tuple[str, Path]) -> None:
    port = urlsplit(app[0]).port
    assert port is not None
    with pytest.raises(OSError, match=r"refused|unreachable"), socket.create_connection(("127.0.0.2", port), timeout=2):
        pass


def test_without_the_extra_the_remedy_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.app.server.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r'panel, which is not installed; run: pip install "thermofuse\[app\]"'):
        serve(tmp_path)
    answer = CliRunner().invoke(command, ["app", str(tmp_path)])
    assert answer.exit_code == 2 and "pip install" in answer.output


def test_a_folder_must_exist(tmp_path: Path) -> None:
    assert importlib.util.find_spec("panel")
    with pytest.raises(PlaceError, match="no such folder"):
        serve(tmp_path / "absent")
