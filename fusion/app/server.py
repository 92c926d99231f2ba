"""The server: on this machine only, on a free port, with a token in its address, and all of its parts from installed packages."""

from __future__ import annotations

import asyncio
import hmac
import logging
import os
import secrets
import tempfile
import threading
import tomllib
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import panel as pn
from bokeh.core.validation import silence
from bokeh.core.validation.warnings import EMPTY_LAYOUT
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from panel.io.application import build_applications
from panel.theme.base import Design, Inherit
from panel.viewable import Viewable
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.netutil import bind_sockets
from tornado.web import OutputTransform, RequestHandler

from fusion.app.parts import PathError, ReportHandler, State, column, note, schedule_update, state_of, switched, telling
from fusion.app.runs import RUNS

# Authentication: every request is checked here before any page, file or connection answers it.

#: A page runs the scripts of this server alone and compiles none, so no part of a page may be one that does (FlexBox, CustomJS).
_CONTENT = (
    "default-src 'self'; script-src 'self' 'nonce-{nonce}'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "font-src 'self' data:; connect-src 'self' ws://{host}; frame-src 'self'; object-src 'none'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'self'"
)
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Frame-Options": "SAMEORIGIN",
}


class Credentials:
    """Token of the printed address, the cookie that a browser gets for it, and the values of the header Host of this server."""

    def __init__(self, port: int) -> None:
        self.hosts = (f"127.0.0.1:{port}", f"localhost:{port}")
        self.token = secrets.token_urlsafe(32)
        self.cookie = f"thermofuse-{port}"
        self.secret = secrets.token_urlsafe(32)

    @property
    def address(self) -> str:
        """Address that opens the application in a browser."""
        return f"http://{self.hosts[0]}/?token={self.token}"

    def refusal(self, request: HTTPServerRequest) -> str:
        """Say why a request does not come from a page of this server; empty where it does."""
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        if host not in self.hosts:
            return "this server does not answer to that host name; open the address that thermofuse app printed"
        changes = request.method not in ("GET", "HEAD") or request.headers.get("Upgrade", "").lower() == "websocket"
        if origin is None:
            return "a request that changes something must say where it comes from" if changes else ""
        return "" if origin == f"http://{host}" else "a page of another site asked; nothing is answered to it"

    def is_authenticated(self, request: HTTPServerRequest) -> bool:
        """Tell whether a request carries the cookie of this server."""
        cookie = request.cookies.get(self.cookie)
        return cookie is not None and _equal(cookie.value, self.secret)

    def is_sign_in(self, request: HTTPServerRequest) -> bool:
        """Tell whether a request is the printed address with its token."""
        token = request.query_arguments.get("token", [b""])[-1].decode("utf-8", "replace")
        return urlsplit(request.uri or "").path == "/" and request.method == "GET" and _equal(token, self.token)


def _equal(given: str, expected: str) -> bool:
    """Compare in a time that does not depend on what is given."""
    return hmac.compare_digest(given.encode("utf-8", "surrogateescape"), expected.encode())


class Forbidden(RequestHandler):
    """Answers 403 with the reason, whatever was asked."""

    def initialize(self, reason: str) -> None:
        """Keep the reason."""
        self._why = reason

    def prepare(self) -> None:
        """Refuse before any method is called."""
        self.set_status(403)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"403: {self._why}\n")


#: A page that leads to another address at once.
_ONWARD = '<!DOCTYPE html><title>thermofuse</title><meta http-equiv="refresh" content="0;url={0}"><a href="{0}">thermofuse</a>\n'


class SignIn(RequestHandler):
    """Changes the token of the printed address for a cookie, and leads to the address without it."""

    def initialize(self, credentials: Credentials) -> None:
        """Keep the credentials."""
        self._credentials = credentials

    def get(self) -> None:
        """Set the cookie; scripts cannot read it, and no other site makes a browser send it."""
        cookie, secret = self._credentials.cookie, self._credentials.secret
        self.set_cookie(cookie, secret, httponly=True, samesite="Strict", path="/")
        self.set_header("Cache-Control", "no-store")
        if self.request.headers.get("Sec-Fetch-Site") == "cross-site":
            # A redirect would count as one of the file that led here, and the browser would keep the cookie back.
            self.finish(_ONWARD.format("/"))
        else:
            self.redirect("/")


class SecurityHeaders(OutputTransform):
    """Adds to every answer what a browser may do with it, and marks the scripts of the page as its own."""

    def __init__(self, request: HTTPServerRequest) -> None:
        super().__init__(request)
        self._host = request.headers.get("Host", "")

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        """Set the headers; an answer that has a stricter policy of its own keeps it."""
        headers.update(_HEADERS)
        if "Content-Security-Policy" in headers:
            return status_code, headers, chunk
        nonce = secrets.token_urlsafe(16)
        headers["Content-Security-Policy"] = _CONTENT.format(nonce=nonce, host=self._host)
        if headers.get("Content-Type", "").startswith("text/html"):
            # Contents of files are in the page as JSON, where "<" is escaped: every such tag is the template's own.
            chunk = chunk.replace(b"<script", f'<script nonce="{nonce}"'.encode())
            headers["Content-Length"] = str(len(chunk))
        return status_code, headers, chunk


class AuthenticatedApplication(BokehTornado):
    """The application, which answers only to a browser that has signed in."""

    def __init__(self, applications: dict[str, Any], *, credentials: Credentials, **options: Any) -> None:
        self._credentials = credentials
        super().__init__(applications, extra_websocket_origins=credentials.hosts, **options)
        self.add_transform(SecurityHeaders)

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> Any:
        """Choose who answers: the asked handler for those who are let in, a refusal for all others."""
        known = self._credentials
        reason = known.refusal(request)
        if not reason and known.is_sign_in(request):
            return self.get_handler_delegate(request, SignIn, {"credentials": known})
        if not (reason or known.is_authenticated(request)):
            reason = "this browser has not opened the address with the token that thermofuse app printed; open that one first"
        if reason:
            return self.get_handler_delegate(request, Forbidden, {"reason": reason})
        return super().find_handler(request, **kwargs)


# The page: a bar of screens above the one that is shown, in the style of the report.

_TEMPLATES = Path(__file__).parent / "templates"

#: Screens in the order of the work, with the module and the function that builds them: what a screen needs is imported when it is opened.
SCREENS = {
    "Set up": ("setup.screen", "set_up"),
    "Run": ("run", "run_screen"),
    "Results": ("results", "results_screen"),
    "Compare": ("compare", "compare_screen"),
    "Live": ("live", "live_screen"),
}


#: Screens that need no data.
_ALWAYS = ("Set up", "Run")


def offered(state: State) -> list[str]:
    """Return the screens that have something to show: results, two of them to compare, a test of camera or laser to follow."""
    from fusion.app.compare import find_results

    finished, _ = find_results(state.root)
    there = {
        "Results": bool(finished) or state.results is not None,
        "Compare": len(finished) > 1,
        "Live": state.campaign is not None and _can_be_followed(state.campaign),
    }
    return [name for name in SCREENS if there.get(name, name in _ALWAYS)]


def _can_be_followed(campaign: Path) -> bool:
    """Tell whether a campaign file names an instrument whose files may still grow."""
    try:
        return not {"interferometry", "thermography"}.isdisjoint(tomllib.loads(campaign.read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return False


def _screen(name: str, state: State) -> Viewable:
    """Build a screen, which shows the state of the page, and changes it."""
    module, function = SCREENS[name]
    screen: Viewable = getattr(import_module(f"fusion.app.{module}"), function)(state)
    return screen


class Look(Design):
    """Style of every part of a screen: a part sees the page's own rules no more than those of another part."""

    modifiers = {Viewable: {"stylesheets": [Inherit, (_TEMPLATES / "parts.css").read_text(encoding="utf-8")]}}  # noqa: RUF012


def build_page(root: Path) -> Any:
    """Build the page for one tab of a browser."""
    pn.extension("filedropper")
    state = state_of(root)
    builders = {name: partial(_screen, name, state) for name in SCREENS}
    bar, content = switched("Screens", builders, next(iter(SCREENS)))
    bar.options = list(_ALWAYS)

    def go(screen: str) -> None:
        shown = {*bar.options, screen}
        bar.param.update(options=[name for name in SCREENS if name in shown], value=screen)

    place = column(note(f"Folder {state.root}"))

    async def offer(*events: object) -> None:
        with telling(place, [note(f"Folder {state.root}")]):
            shown = {*await asyncio.to_thread(offered, state), bar.value}
            schedule_update(lambda: bar.param.update(options=[name for name in SCREENS if name in shown]))

    bar.param.watch(lambda event: state.param.update(screen=event.new), "value")
    state.param.watch(lambda event: go(event.new), "screen")
    # What the folder holds is looked for when the first screen stands.
    state.param.watch(offer, ["looked", "campaign", "results"])
    page = pn.Template((_TEMPLATES / "page.html.j2").read_text(encoding="utf-8"), design=Look)
    page.add_variable("style", (_TEMPLATES / "page.css").read_text(encoding="utf-8"))
    page.add_variable("watched", (_TEMPLATES / "page.js").read_text(encoding="utf-8"))
    page.add_panel("bar", bar)
    page.add_panel("place", place)
    page.add_panel("content", content)
    return page


#: Largest message of a page: a chunk of an uploaded file with its frame.
_LARGEST_MESSAGE = 12 * 1024 * 1024
#: How long a page that was sent waits for its browser to answer: one that comes later is built anew, and asks other hosts for its styles.
_WAITS_FOR_BROWSER_MS = 600_000
_ADDRESS = "127.0.0.1"


#: What the first screen reads a folder with: it is loaded while the browser starts.
AHEAD = (
    "fusion.app.setup.screen", "fusion.campaign.config", "interferometry.io.readings", "fusion.campaign.logs",
    "fusion.results.results",
)  # fmt: skip


def serve(root: Path, *, port: int = 0, open_browser: bool = False, say: Callable[[str], None] = print) -> None:
    """Serve the application until the process is told to stop."""
    if not root.is_dir():
        raise PathError(f"{root}: no such folder; name the folder that holds the files of the measurement")
    server, address = build_server(root, port=port)
    # Sheets in Word are drawn in a thread, where no window may open.
    os.environ.setdefault("MPLBACKEND", "agg")
    server.start()
    say(address)
    threading.Thread(target=lambda: [import_module(name) for name in AHEAD], daemon=True).start()
    try:
        with opened_in_browser(address) if open_browser else nullcontext():
            server.io_loop.start()
    finally:
        RUNS.end()
        server.stop(wait=False)


@contextmanager
def opened_in_browser(address: str) -> Iterator[Path]:
    """Open an address by a file that its owner alone can read: every user of a machine sees the arguments of programs."""
    try:
        # Browsers in a sandbox see neither the folder of temporary files nor hidden files.
        descriptor, name = tempfile.mkstemp(".html", "thermofuse-", Path.home())
    except (OSError, RuntimeError):
        descriptor, name = tempfile.mkstemp(".html", "thermofuse-")
    try:
        os.close(descriptor)
        Path(name).write_text(_ONWARD.format(address), encoding="utf-8")
        webbrowser.open(Path(name).as_uri())
        yield Path(name)
    finally:
        Path(name).unlink(missing_ok=True)


def build_server(root: Path, *, port: int = 0) -> tuple[Any, str]:
    """Make the server, which already owns its port but answers only when it is started."""
    # A part of a screen may have nothing to show yet.
    silence(EMPTY_LAYOUT)
    sockets = bind_sockets(port, _ADDRESS)
    credentials = Credentials(sockets[0].getsockname()[1])
    # Refusals are answered, not written down: the log would repeat what strangers send.
    logging.getLogger("tornado.access").setLevel(logging.ERROR)
    application = AuthenticatedApplication(
        build_applications({"/": lambda: build_page(root)}, title="thermofuse"),
        credentials=credentials,
        websocket_max_message_size_bytes=_LARGEST_MESSAGE,
        unused_session_lifetime_milliseconds=_WAITS_FOR_BROWSER_MS,
        extra_patterns=[(r"/report/(.*)", ReportHandler, {"root": root})],
        include_headers=[],
        include_cookies=[],
    )
    http = HTTPServer(application, max_body_size=1024 * 1024)
    http.add_sockets(sockets)
    return BaseServer(IOLoop.current(), application, http), credentials.address
