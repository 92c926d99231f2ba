"""The server: on this machine only, on a free port, with a token in its address, and all of its parts from installed packages."""

from __future__ import annotations

import logging
import webbrowser
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fusion.app.places import PlaceError
from fusion.errors import FusionError

#: Largest message of a page: a chunk of an uploaded file with its frame.
_LARGEST_MESSAGE = 12 * 1024 * 1024
_ADDRESS = "127.0.0.1"


class MissingExtraError(FusionError):
    """The application was asked for without the packages that it needs."""


def serve(root: Path, *, port: int = 0, open_browser: bool = False, say: Callable[[str], None] = print) -> None:
    """Serve the application until the process is told to stop.

    Parameters
    ----------
    root : Path
        Folder that it may read and write, with its subfolders.
    port : int
        0: a free one.
    open_browser : bool
        Whether the system's browser opens the address.
    say : callable
        Takes the address, when the server listens.

    Raises
    ------
    MissingExtraError
        If the packages of the extra ``app`` are not installed.
    PlaceError
        If `root` is no folder.
    """
    if find_spec("panel") is None:
        raise MissingExtraError(
            'thermofuse app needs the package panel, which is not installed; run: pip install "thermofuse[app]"'
        )
    if not root.is_dir():
        raise PlaceError(f"{root}: no such folder; name the folder that holds the files of the measurement")
    server, address = build_server(root, port=port)
    from fusion.app.run.process import RUNS

    server.start()
    say(address)
    if open_browser:
        webbrowser.open(address)
    try:
        server.io_loop.start()
    finally:
        RUNS.end()
        server.stop(wait=False)


def build_server(root: Path, *, port: int = 0) -> tuple[Any, str]:
    """Make the server, which already owns its port but answers only when it is started.

    Parameters
    ----------
    root : Path
        Folder that it may read and write.
    port : int
        0: a free one.

    Returns
    -------
    BaseServer
        Of Bokeh.
    str
        Address with the token.
    """
    from bokeh.core.validation import silence
    from bokeh.core.validation.warnings import EMPTY_LAYOUT
    from bokeh.server.server import BaseServer
    from panel.io.application import build_applications
    from tornado.httpserver import HTTPServer
    from tornado.ioloop import IOLoop
    from tornado.netutil import bind_sockets

    from fusion.app.gate import Gate, Keys
    from fusion.app.page import build_page
    from fusion.app.report import ReportHandler

    # A part of a screen may have nothing to show yet.
    silence(EMPTY_LAYOUT)
    sockets = bind_sockets(port, _ADDRESS)
    keys = Keys(sockets[0].getsockname()[1])
    # Refusals are answered, not written down: the log would repeat what strangers send.
    logging.getLogger("tornado.access").setLevel(logging.ERROR)
    gate = Gate(
        build_applications({"/": lambda: build_page(root)}, title="thermofuse"),
        keys=keys,
        websocket_max_message_size_bytes=_LARGEST_MESSAGE,
        extra_patterns=[(r"/report/(.*)", ReportHandler, {"root": root})],
        include_headers=[],
        include_cookies=[],
    )
    http = HTTPServer(gate, max_body_size=1024 * 1024)
    http.add_sockets(sockets)
    return BaseServer(IOLoop.current(), gate, http), keys.address
