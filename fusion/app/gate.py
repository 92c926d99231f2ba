"""Who is let in: every request passes here before any page, file or connection answers it."""

from __future__ import annotations

import hmac
import secrets
from typing import Any
from urllib.parse import urlsplit

from bokeh.server.tornado import BokehTornado
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.web import OutputTransform, RequestHandler

#: Bokeh compiles the small functions of its pages, hence 'unsafe-eval'; nothing comes from another host.
_CONTENT = (
    "default-src 'self'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
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


class Keys:
    """What opens the application of one process.

    Parameters
    ----------
    port : int
        Port of the server.

    Attributes
    ----------
    hosts : tuple of str
        Values of the header Host that name this server.
    token : str
        In the address that is printed.
    cookie, secret : str
        Name and value of the cookie that a browser gets for the token.
    """

    def __init__(self, port: int) -> None:
        self.hosts = (f"127.0.0.1:{port}", f"localhost:{port}")
        self.token = secrets.token_urlsafe(32)
        self.cookie = f"thermofuse-{port}"
        self.secret = secrets.token_urlsafe(32)

    @property
    def address(self) -> str:
        """Address that opens the application in a browser."""
        return f"http://{self.hosts[0]}/?token={self.token}"


def refusal(request: HTTPServerRequest, keys: Keys) -> str:
    """Say why a request does not come from a page of this server.

    Parameters
    ----------
    request : HTTPServerRequest
        Any request, also one that opens a websocket.
    keys : Keys
        Of the server.

    Returns
    -------
    str
        Empty where the addresses are right. A foreign Host means that another name points to this machine (DNS rebinding), a foreign
        Origin that a page of another site asks; a change needs an Origin.
    """
    host = request.headers.get("Host", "")
    if host not in keys.hosts:
        return "this server does not answer to that host name; open the address that thermofuse app printed"
    origin = request.headers.get("Origin")
    changes = request.method not in ("GET", "HEAD") or request.headers.get("Upgrade", "").lower() == "websocket"
    if origin is None:
        return "a request that changes something must say where it comes from" if changes else ""
    if origin != f"http://{host}":
        return "a page of another site asked; nothing is answered to it"
    return ""


def is_known(request: HTTPServerRequest, keys: Keys) -> bool:
    """Tell whether a request carries the cookie of this server, compared in a time that does not depend on it.

    Parameters
    ----------
    request : HTTPServerRequest
        Any request.
    keys : Keys
        Of the server.
    """
    cookie = request.cookies.get(keys.cookie)
    return cookie is not None and _equal(cookie.value, keys.secret)


def _equal(given: str, expected: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "surrogateescape"), expected.encode())


class Refused(RequestHandler):
    """Answers 403 with the reason."""

    def initialize(self, reason: str) -> None:
        """Keep the reason."""
        self._why = reason

    def prepare(self) -> None:
        """Refuse, whatever was asked."""
        self.set_status(403)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"403: {self._why}\n")


class SignIn(RequestHandler):
    """Changes the token of the printed address for a cookie, and leads to the address without it."""

    def initialize(self, keys: Keys) -> None:
        """Keep the keys."""
        self._keys = keys

    def get(self) -> None:
        """Set the cookie; scripts cannot read it, and no other site makes a browser send it."""
        self.set_cookie(self._keys.cookie, self._keys.secret, httponly=True, samesite="Strict", path="/")
        self.set_header("Cache-Control", "no-store")
        self.redirect("/")


class Protected(OutputTransform):
    """Adds to every answer what a browser may do with it, and marks the scripts of the page as its own."""

    def __init__(self, request: HTTPServerRequest) -> None:
        super().__init__(request)
        self._host = request.headers.get("Host", "")

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        """Set the headers; an answer that has a stricter policy of its own keeps it."""
        for name, value in _HEADERS.items():
            headers[name] = value
        if "Content-Security-Policy" in headers:
            return status_code, headers, chunk
        nonce = secrets.token_urlsafe(16)
        headers["Content-Security-Policy"] = _CONTENT.format(nonce=nonce, host=self._host)
        if headers.get("Content-Type", "").startswith("text/html"):
            # Contents of files are in the page as JSON, where "<" is escaped: every such tag is the template's own.
            chunk = chunk.replace(b"<script", f'<script nonce="{nonce}"'.encode())
            headers["Content-Length"] = str(len(chunk))
        return status_code, headers, chunk


class Gate(BokehTornado):
    """The application behind its gate.

    Parameters
    ----------
    applications : dict
        As for BokehTornado.
    keys : Keys
        Of the server.
    **options
        Further ones of BokehTornado.
    """

    def __init__(self, applications: dict[str, Any], *, keys: Keys, **options: Any) -> None:
        self._keys = keys
        super().__init__(applications, extra_websocket_origins=keys.hosts, **options)
        self.add_transform(Protected)

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> Any:
        """Choose who answers: the asked handler for those who are let in, a refusal for all others."""
        reason = refusal(request, self._keys)
        if reason:
            return self.get_handler_delegate(request, Refused, {"reason": reason})
        token = request.query_arguments.get("token", [b""])[-1].decode("utf-8", "replace")
        if urlsplit(request.uri or "").path == "/" and request.method == "GET" and _equal(token, self._keys.token):
            return self.get_handler_delegate(request, SignIn, {"keys": self._keys})
        if not is_known(request, self._keys):
            reason = "this browser has not opened the address with the token that thermofuse app printed; open that one first"
            return self.get_handler_delegate(request, Refused, {"reason": reason})
        return super().find_handler(request, **kwargs)
