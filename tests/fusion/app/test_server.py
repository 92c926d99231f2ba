"""The running server: what it refuses, what it sends with every answer, and what it says when it cannot start."""

import shutil
import socket
import stat
import subprocess
import sys
import webbrowser
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from tornado.httputil import HTTPHeaders, HTTPServerRequest, RequestStartLine

from fusion.app.parts import PathError, state_of
from fusion.app.server import SCREENS, Credentials, offered, opened_in_browser, serve

#: What opens the page, its connection, its scripts, and the data.
STATIC = ("/static/js/bokeh.min.js", "/static/extensions/panel/panel.min.js")
PATHS = ("/", "/ws", *STATIC, "/report/results/report.html", "/none")


def test_the_token_becomes_a_cookie_that_scripts_and_other_sites_do_not_get(app, ask):
    answer = ask(app[0], f"/?{urlsplit(app[0]).query}")
    assert answer.status == 302 and answer.headers["Location"] == "/"
    assert "HttpOnly" in answer.headers["Set-Cookie"] and "SameSite=Strict" in answer.headers["Set-Cookie"]


@pytest.mark.browser
def test_a_browser_is_led_to_the_first_screen_by_a_file_of_the_user_and_no_argument_or_address_holds_the_token(
    app, new_page, tmp_path, monkeypatch
):
    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    with opened_in_browser(app[0]) as file:
        assert stat.S_IMODE(file.stat().st_mode) == 0o600 and file.parent == tmp_path
        assert opened == [file.as_uri()] and urlsplit(app[0]).query not in opened[0]
        page = new_page("about:blank").context.browser.new_context().new_page()
        assert page.goto(app[0].split("/?")[0]).status == 403
        page.goto(file.as_uri())
        page.get_by_role("heading", name=next(iter(SCREENS)), exact=True).wait_for()
        assert page.title() == "thermofuse" and "token" not in page.url
    assert not file.exists()
    assert page.context.request.get(page.url).ok, "another tab needs no token"
    # Results of one test are nothing to compare.
    page.get_by_role("button", name="Live", exact=True).wait_for()
    shown = [name for name in SCREENS if page.get_by_role("button", name=name, exact=True).count()]
    assert shown == ["Set up", "Run", "Results", "Live"]


@pytest.mark.parametrize("path", PATHS)
def test_a_stranger_gets_403_everywhere(app, ask, path):
    for query in ("", "?token=", "?token=x", "?token=%FF"):
        answer = ask(app[0], path + query)
        assert answer.status == 403 and b"open that one first" in answer.body
    assert ask(app[0], path, Upgrade="websocket", Connection="Upgrade", Origin=app[0].split("/?")[0]).status == 403


@pytest.mark.parametrize("path", PATHS)
def test_another_site_and_another_name_get_nothing(app, cookie, ask, path):
    for method in ("GET", "POST"):
        assert ask(app[0], path, method=method, Cookie=cookie, Origin="http://evil.example").status == 403
        assert ask(app[0], path, method=method, Cookie=cookie, Host="evil.example").status == 403
    token = urlsplit(app[0]).query
    assert "Set-Cookie" not in ask(app[0], f"{path}?{token}", Host="evil.example").headers


def test_every_answer_says_what_a_browser_may_do_with_it(app, cookie, ask):
    for answer in (ask(app[0], "/"), ask(app[0], "/", Cookie=cookie), ask(app[0], "/none", Cookie=cookie)):
        policy = answer.headers["Content-Security-Policy"]
        assert "default-src 'self'" in policy and "script-src 'self' 'nonce-" in policy
        assert "script-src 'self' 'unsafe-inline'" not in policy and "unsafe-eval" not in policy
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"


def test_the_page_names_no_other_host(app, cookie, ask):
    page = ask(app[0], "/", Cookie=cookie).body.decode()
    assert "https://" not in page and "http://" not in page
    assert cookie.split("=")[1] not in page, "a script of the page cannot learn the cookie"


def test_it_listens_on_this_machine_only(app):
    port = urlsplit(app[0]).port
    assert port is not None
    with pytest.raises(OSError, match=r"refused|unreachable"), socket.create_connection(("127.0.0.2", port), timeout=2):
        pass


def test_a_folder_must_exist(tmp_path):
    with pytest.raises(PathError, match="no such folder"):
        serve(tmp_path / "absent")


OWN = Credentials(8765)


class _Connection:
    """What Tornado asks of the connection of a request."""

    context = None

    def set_close_callback(self, callback):
        pass


def asked(method="GET", **headers):
    fields = {"Host": "127.0.0.1:8765"} | headers
    line = RequestStartLine(method, "/", "HTTP/1.1")
    return HTTPServerRequest(start_line=line, headers=HTTPHeaders(fields), connection=_Connection())


@pytest.mark.parametrize(
    "host", ["evil.example:8765", "127.0.0.1", "127.0.0.1:80", "localhost", "127.0.0.1:8765.evil.example", ""]
)
def test_another_host_name_is_refused(host):
    assert "host name" in OWN.refusal(asked(Host=host))


@pytest.mark.parametrize("origin", ["http://evil.example", "https://127.0.0.1:8765", "http://127.0.0.1:80", "null", ""])
def test_another_origin_is_refused(origin):
    assert "another site" in OWN.refusal(asked(Origin=origin))


def test_what_changes_something_says_where_it_comes_from():
    assert "must say" in OWN.refusal(asked("POST"))
    assert "must say" in OWN.refusal(asked(Upgrade="WebSocket"))
    assert not OWN.refusal(asked("POST", Origin="http://127.0.0.1:8765"))
    assert not OWN.refusal(asked())
    assert not OWN.refusal(asked(Host="localhost:8765", Origin="http://localhost:8765"))


def test_only_the_cookie_of_this_server_is_known():
    assert OWN.is_authenticated(asked(Cookie=f"thermofuse-8765={OWN.secret}"))
    for cookie in (
        "",
        "thermofuse-8765=",
        f"thermofuse-1={OWN.secret}",
        f"thermofuse-8765={OWN.token}",
        "thermofuse-8765=é",
    ):
        assert not OWN.is_authenticated(asked(Cookie=cookie))


def test_screens_are_offered_for_which_there_are_data(tmp_path):
    state = state_of(tmp_path)
    assert offered(state) == ["Set up", "Run"]
    for name in ("before", "after"):
        (tmp_path / name).mkdir()
        for product in ("results.json", "provenance.json"):
            (tmp_path / name / product).write_text("{}")
    assert offered(state) == ["Set up", "Run", "Results", "Compare"]
    campaign = tmp_path / "campaign.toml"
    for table, followed in (("record", False), ("interferometry", True)):
        campaign.write_text(f"[{table}]\n")
        state.campaign = campaign
        assert ("Live" in offered(state)) is followed


@pytest.mark.long
def test_what_a_folder_is_recognised_with_is_loaded_while_the_browser_starts(campaign_folder):
    code = (
        "import sys, pathlib, importlib; sys.modules['dask'] = None  # as the command has it\nfrom fusion.app.server import AHEAD\n"
        "for name in AHEAD: importlib.import_module(name)\n"
        "from fusion.app.setup.screen import found_in_folder; before = set(sys.modules)\n"
        "found_in_folder(pathlib.Path(sys.argv[1])); print(*sorted(set(sys.modules) - before))"
    )
    done = subprocess.run([sys.executable, "-c", code, campaign_folder], capture_output=True, text=True, check=True)
    large = {"pandas", "xarray", "dask", "scipy", "pydantic", "panel", "cv2"}
    late = [name for name in done.stdout.split() if name.partition(".")[0] in large]
    assert len(late) < 5, f"one part of a package may come late, none as a whole: {late}"


def test_credentials_are_long_and_new_for_every_server():
    other = Credentials(8765)
    assert len({OWN.token, OWN.secret, other.token, other.secret}) == 4
    assert min(map(len, (OWN.token, OWN.secret))) >= 43, "256 bits"
    assert OWN.address == f"http://127.0.0.1:8765/?token={OWN.token}"


def test_no_screen_breaks_a_rule_of_accessibility_in_the_light_or_the_dark_or_scrolls_sideways_on_a_phone(
    app, new_page
):
    from axe_playwright_python.sync_playwright import Axe

    if not (app[1] / "before").exists():
        shutil.copytree(app[1] / "results", app[1] / "before")
    page = new_page(app[0], width=390, bypass_csp=True)
    assert "token" not in page.url
    page.get_by_text("12 fiducials agree").wait_for()
    page.get_by_role("button", name="Compare", exact=True).wait_for()
    page.get_by_role("slider", name="Camera clock minus laser clock (s)").wait_for()
    for name in ("Set up", "Run", "Results", "Compare", "Live"):
        page.get_by_role("button", name=name, exact=True).first.press("Enter")
        page.get_by_role("heading", name=name, exact=True).wait_for()
        page.wait_for_function("document.documentElement.scrollWidth <= 390")
        # A theme changes colours alone.
        for scheme, rules in (("light", {}), ("dark", {"runOnly": ["color-contrast"]})):
            page.emulate_media(color_scheme=scheme)
            page.wait_for_timeout(1000)
            found = Axe().run(page, options={"resultTypes": ["violations"], **rules}).response["violations"]
            assert not [(name, scheme, one["id"], one["nodes"][0]["html"]) for one in found]
