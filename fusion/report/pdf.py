"""A report on paper: printed to PDF by an installed browser."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from fusion.errors import FusionError
from fusion.products.store import write_atomically

#: Commands of the browsers that can print without a window, in the order in which they are looked for.
_COMMANDS = (
    "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge", "microsoft-edge-stable", "msedge",
    "brave-browser",
)  # fmt: skip
#: Where they are installed without being on the path: macOS and Windows.
_PLACES = (
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
    "/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge",
    r"C:\Program Files\Google\Chrome\Application\chrome.exe",
    r"C:\Program Files (x86)\Google\Chrome\Application\chrome.exe",
    r"C:\Program Files (x86)\Microsoft\Edge\Application\msedge.exe",
    r"C:\Program Files\Microsoft\Edge\Application\msedge.exe",
)
_LONGEST_S = 180


class PrintError(FusionError):
    """A report cannot be printed to PDF."""


def find_browser(named: str | None = None) -> str:
    """Return the browser that prints.

    Parameters
    ----------
    named : str, optional
        Command or file that the user names; None: the first of Chromium, Chrome, Edge and Brave that is installed.

    Returns
    -------
    str
        Its file.

    Raises
    ------
    PrintError
        If there is none.
    """
    if named is not None:
        found = shutil.which(named)
        if found is None:
            raise PrintError(
                f'--browser "{named}": there is no such program; name the file of Chrome, Chromium or Edge'
            )
        return found
    for candidate in (*_COMMANDS, *_PLACES):
        found = shutil.which(candidate)
        if found is not None:
            return found
    raise PrintError(
        "no browser that can print was found (looked for Chromium, Chrome, Edge and Brave); install one, name it with --browser FILE, or "
        "open report.html and press its button Print"
    )


def print_pdf(page: str, out: Path, *, browser: str | None = None, full: bool = False) -> Path:
    """Print a page to a PDF file.

    Parameters
    ----------
    page : str
        The page as HTML text.
    out : Path
        File to write; one that exists is replaced when the new one is whole.
    browser : str, optional
        See `find_browser`.
    full : bool
        Whether parts that are folded on the screen are printed too.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    PrintError
        If there is no browser, or it prints nothing.

    Notes
    -----
    The browser runs without a window, a profile of the user or a network: the page is one file.
    """
    program = find_browser(browser)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "report.html"
        file.write_text(page, encoding="utf-8")
        return write_atomically(
            out, lambda temporary: _print(program, f"{file.as_uri()}#on-a4{'-full' if full else ''}", temporary, folder)
        )


def _print(program: str, address: str, out: Path, profile: str) -> None:
    """Run the browser until it has printed."""
    command = [
        program, "--headless", "--disable-gpu", "--no-first-run", "--no-pdf-header-footer", f"--user-data-dir={profile}/profile",
        "--window-size=1000,1400", "--virtual-time-budget=60000", f"--print-to-pdf={out.resolve()}", address,
    ]  # fmt: skip
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        command.insert(1, "--no-sandbox")  # a browser refuses to run for root with its sandbox
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PrintError(f"{program} did not print: {error}; name another browser with --browser FILE") from error
    if done.returncode or not out.exists() or not out.stat().st_size:
        said = done.stderr.strip().splitlines()
        raise PrintError(
            f"{program} ended with {done.returncode} and printed nothing{': ' + said[-1] if said else ''}; name another browser with "
            "--browser FILE"
        )
