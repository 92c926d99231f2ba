"""Strangers, other sites and other host names are refused; the token becomes a cookie."""

from __future__ import annotations

import pytest
from tornado.httputil import HTTPHeaders, HTTPServerRequest, RequestStartLine

from fusion.app.gate import Keys, is_known, refusal

KEYS = Keys(8765)


class _Connection:
    """What Tornado asks of the connection of a request."""

    context = None

    def set_close_callback(self, callback: object) -> None:
        pass


def asked(method: str = "GET", **headers: str) -> HTTPServerRequest:
    fields = {"Host": "127.0.0.1:8765"} | {name.replace("_", "-"): value for name, value in headers.items()}
    line = RequestStartLine(method, "/", "HTTP/1.1")
    return HTTPServerRequest(start_line=line, headers=HTTPHeaders(fields), connection=_Connection())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "host", ["evil.example:8765", "127.0.0.1", "127.0.0.1:80", "localhost", "127.0.0.1:8765.evil.example", ""]
)
def test_another_host_name_is_refused(host: str) -> None:
    assert "host name" in refusal(asked(Host=host), KEYS)


@pytest.mark.parametrize("origin", ["http://evil.example", "https://127.0.0.1:8765", "http://127.0.0.1:80", "null", ""])
def test_another_origin_is_refused(origin: str) -> None:
    assert "another site" in refusal(asked(Origin=origin), KEYS)


def test_what_changes_something_says_where_it_comes_from() -> None:
    assert "must say" in refusal(asked("POST"), KEYS)
    assert "must say" in refusal(asked(Upgrade="WebSocket"), KEYS)
    assert not refusal(asked("POST", Origin="http://127.0.0.1:8765"), KEYS)
    assert not refusal(asked(), KEYS)
    assert not refusal(asked(Host="localhost:8765", Origin="http://localhost:8765"), KEYS)


def test_only_the_cookie_of_this_server_is_known() -> None:
    assert is_known(asked(Cookie=f"thermofuse-8765={KEYS.secret}"), KEYS)
    for cookie in (
        "",
        "thermofuse-8765=",
        f"thermofuse-1={KEYS.secret}",
        f"thermofuse-8765={KEYS.token}",
        "thermofuse-8765=é",
    ):
        assert not is_known(asked(Cookie=cookie), KEYS)


def test_keys_are_long_and_new_for_every_server() -> None:
    other = Keys(8765)
    assert len({KEYS.token, KEYS.secret, other.token, other.secret}) == 4
    assert min(map(len, (KEYS.token, KEYS.secret))) >= 43, "256 bits"
    assert KEYS.address == f"http://127.0.0.1:8765/?token={KEYS.token}"
