"""The report of a run, as a page of the application."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

from tornado.web import RequestHandler

from fusion.app.places import PlaceError, place_within

_NAME = "report.html"


def report_link(root: Path, results: Path) -> str:
    """Return the address of a report within the application.

    Parameters
    ----------
    root : Path
        Folder for which the application was started.
    results : Path
        Results folder inside it.
    """
    return f"/report/{quote((results.resolve() / _NAME).relative_to(root.resolve()).as_posix())}"


class ReportHandler(RequestHandler):
    """Sends ``report.html`` of a results folder inside the folder of the application, and no other file."""

    def initialize(self, root: Path) -> None:
        """Keep the folder."""
        self._root = root

    def get(self, written: str) -> None:
        """Send it in a sandbox: its scripts draw charts, and reach neither the application nor the network."""
        try:
            place = place_within(self._root, written.lstrip("/"))
        except PlaceError:
            place = None
        if place is None or place.name != _NAME or not place.is_file() or not (place.parent / "results.json").is_file():
            self.set_status(404)
            self.finish("404: there is no report in that folder\n")
            return
        self.set_header("Content-Type", "text/html; charset=utf-8")
        self.set_header("Cache-Control", "no-store")
        self.set_header(
            "Content-Security-Policy",
            "sandbox allow-scripts allow-downloads allow-modals allow-popups; default-src 'none'; script-src 'unsafe-inline' "
            "'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:; base-uri 'none'; form-action 'none'",
        )
        self.finish(place.read_bytes())
