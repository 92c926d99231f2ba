"""The application as a user starts it, in a process of its own, and a browser in front of it."""

import http.client
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from fusion.app.results import Products
from tests.browser import CHROMIUM, record_faults


@contextmanager
def started(folder: Path) -> Iterator[str]:
    """Start `thermofuse app` for a folder; yields the address that it prints."""
    command = [sys.executable, "-m", "thermofuse", "app", str(folder)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"}
    ) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip().removeprefix("app: ")
        finally:
            process.send_signal(signal.SIGTERM)
            assert process.wait(10) == 128 + signal.SIGTERM


@pytest.fixture(scope="module")
def app(campaign_folder, results_folder, tmp_path_factory):
    """Address of an application, and its folder: a finished campaign, and a file outside to which a link leads.

    It remembers what was opened last, so that every file of tests has its own.
    """
    above = tmp_path_factory.mktemp("app")
    folder = above / "folder"
    shutil.copytree(campaign_folder, folder)
    shutil.copytree(results_folder, folder / "results")
    (above / "outside").mkdir()
    (above / "outside" / "report.html").write_text("secret")
    (above / "outside" / "results.json").write_text("{}")
    (folder / "linked").symlink_to(above / "outside")
    with started(folder) as address:
        yield address, folder


@pytest.fixture(scope="session")
def products(results_folder):
    """The products of the small campaign."""
    return Products(results_folder)


@dataclass(frozen=True)
class Answer:
    """What a server answers, read whole."""

    status: int
    headers: http.client.HTTPMessage
    body: bytes


@pytest.fixture(scope="session")
def ask():
    """Return a function that asks a server without a browser; headers are keyword arguments with _ in place of -."""

    def request(address, path, *, method="GET", body=b"", **headers):
        fields = {name.replace("_", "-"): value for name, value in headers.items()}
        with closing(http.client.HTTPConnection(urlsplit(address).netloc, timeout=10)) as connection:
            connection.request(method, path, body=body or None, headers=fields)
            answer = connection.getresponse()
            return Answer(answer.status, answer.headers, answer.read())

    return request


@pytest.fixture(scope="module")
def cookie(app, ask):
    """The cookie that the application gives for its token."""
    return ask(app[0], f"/?{urlsplit(app[0]).query}").headers["Set-Cookie"].split(";")[0]


@pytest.fixture(scope="module")
def new_page():
    """Return a function that opens an address in a new browser session; nothing may leave this machine or fail in a script."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed (Debian: apt-get install chromium)")
    from playwright.sync_api import sync_playwright

    faults = []

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])

        def open_page(address, *, width=1280, **options):
            host = address.split("?")[0]
            page = browser.new_context(viewport={"width": width, "height": 900}, **options).new_page()
            page.set_default_timeout(60_000)
            record_faults(page, faults, own=(host, "data:", "blob:"))
            page.goto(address)
            return page

        yield open_page
        browser.close()
    assert not faults
