"""Take the pictures of README and site: ``python docs/pictures/take.py RESULTS CAMPAIGN_FOLDER PICTURES`` (`make screenshots`).

Each holds a digest of what its page said when it was taken, without numbers. With ``--check`` (`make pictures`) nothing is written, and
pictures whose pages say something else by now are named.
"""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path

import numpy as np
import pandas as pd
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from playwright.sync_api import Browser, Locator, Page, sync_playwright

from fusion.campaign.remote import fetch_sample, read_registry
from fusion.pipeline.run import run_campaign

#: A README loads its pictures for every reader.
_MOST_BYTES = 150_000
#: Name of the picture -> what of the report it shows, and the height of the window in px, in which a page is cut off.
_PARTS = {"report": ("body", 735), "thermal-map": ("#figure-contact_sheet", 705)}
_WIDTH = 1200
_LOADING_MS = 120_000


#: Whether pictures are compared in place of written, and those that are stale.
_CHECKS = "--check" in sys.argv
_stale: list[str] = []
_SHOWS = "shows"


def keep(path: Path, shown: Page | Locator) -> None:
    """Write a picture of a page, or of a part of it, or compare what the part says with what it said when the picture was taken."""
    part = shown.locator("body") if isinstance(shown, Page) else shown
    said = sha256(re.sub(r"[^A-Za-z]+", " ", part.aria_snapshot()).encode()).hexdigest()
    if not _CHECKS:
        path.write_bytes(compact(shown.screenshot(), said))
    elif not path.is_file() or Image.open(path).info.get(_SHOWS) != said:
        _stale.append(path.name)


def compact(picture: bytes, said: str) -> bytes:
    """Return a small PNG: with all colours, or with a palette of its own where that is too large."""
    image, info = Image.open(io.BytesIO(picture)).convert("RGB"), PngInfo()
    info.add_text(_SHOWS, said)
    for kept in (image, image.quantize(256, dither=Image.Dither.NONE)):
        small = io.BytesIO()
        kept.save(small, "PNG", optimize=True, pnginfo=info)
        if small.tell() < _MOST_BYTES:
            return small.getvalue()
    raise SystemExit(f"a picture of {image.size} px is larger than {_MOST_BYTES} bytes; take less of the page")


@contextmanager
def open_app(folder: Path) -> Iterator[str]:
    """Serve a folder in the application; return its address."""
    command = [sys.executable, "-m", "thermofuse", "app", "."]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as app:
        try:
            assert app.stdout is not None
            yield app.stdout.readline().removeprefix("app:").strip()
        finally:
            app.terminate()


@contextmanager
def open_page(browser: Browser, address: str, height: int) -> Iterator[Page]:
    """Open an address in a light window of the pictures' width."""
    page = browser.new_page(viewport={"width": _WIDTH, "height": height}, color_scheme="light")
    page.goto(address)
    yield page
    page.close()


def take_report(browser: Browser, report: Path, folder: Path, parts: Mapping[str, tuple[str, int]] = _PARTS) -> None:
    """Write a picture of every part of a report."""
    for name, (place, height) in parts.items():
        with open_page(browser, report.resolve().as_uri(), height) as page:
            page.wait_for_load_state("networkidle")
            page.wait_for_timeout(2000)
            shown = page if place == "body" else page.locator(place).first
            keep(folder / f"{name}.png", shown)


def take_app(browser: Browser, campaign: Path, results: Path, folder: Path) -> None:
    """Write a picture of the application that shows the results of a campaign."""
    copy = Path(tempfile.mkdtemp()) / "measurement"
    shutil.copytree(campaign, copy)
    shutil.copytree(results, copy / "results", dirs_exist_ok=True)
    try:
        with open_app(copy) as address, open_page(browser, address, 900) as page:
            page.set_default_timeout(_LOADING_MS)
            page.get_by_text("Results", exact=True).first.click()
            page.get_by_text("Open", exact=True).first.click()
            page.get_by_role("button", name="Map", exact=True).click()
            page.get_by_text("largest at x").first.wait_for()
            page.wait_for_timeout(8000)
            page.get_by_role("slider").first.evaluate("element => element.scrollIntoView({block: 'start'})")
            page.wait_for_timeout(1000)
            keep(folder / "app.png", page)
    finally:
        shutil.rmtree(copy.parent)


def take_thermograms(browser: Browser, folder: Path) -> None:
    """Write a picture of the report of public FLIR files: a heated part, from github.com/frkatona/ThermalImageFitter."""
    with tempfile.TemporaryDirectory() as name:
        test = Path(name)
        for sample in (one for one in read_registry() if "ThermalImageFitter" in one):
            shutil.copy(fetch_sample(sample), test)
        (test / "campaign.toml").write_text('campaign.title = "Heated part"\nthermography.frames = ["*.jpg"]\n')
        run_campaign(test / "campaign.toml", test / "results")
        take_report(browser, test / "results" / "report.html", folder, {"only-flir-files": ("body", 800)})


#: Picture of the gallery -> the public files that it is made of, and what it shows of their report.
_GALLERY = {
    "spindle": ("CAIVIAC__FL_THERMAL", ("body", 800)),
    "thermogram": ("FLIR_E40.jpg", ("body", 720)),
}


def take_gallery(browser: Browser, folder: Path) -> None:
    """Write the pictures of reports of public files, and that of a test sheet."""
    with tempfile.TemporaryDirectory() as name:
        for picture, (sample, part) in _GALLERY.items():
            test = Path(name) / picture
            test.mkdir()
            for one in (one for one in read_registry() if sample in one):
                shutil.copy(fetch_sample(one), test)
            subprocess.run([sys.executable, "-m", "thermofuse", "init", str(test), "--yes"], check=True)
            run_campaign(test / "campaign.toml", test / "results")
            take_report(browser, test / "results" / "report.html", folder, {picture: part})
        readings = fetch_sample(next(one for one in read_registry() if one.endswith("target_x.md_ISO230.dat")))
        sheet = Path(name) / "sheet.html"
        subprocess.run([sys.executable, "-m", "thermofuse", "iso230", str(readings), "--out", str(sheet)], check=True)
        take_report(browser, sheet, folder, {"iso230": ("body", 800)})


def take_table(browser: Browser, folder: Path) -> None:
    """Write a picture of the application that asks for the columns of a table."""
    with tempfile.TemporaryDirectory() as name:
        minutes = np.arange(2160) / 6
        warm = 1 - np.exp(-minutes / 60)
        columns = {
            "Time": minutes, "TT_100": 21 + 9.6 * warm, "TT_101": 21 + 0.9 * warm**2, "speed": np.where(minutes < 240, 3000, 0),
            "X": 0.0134 * warm, "Z": 0.016 * warm,
        }  # fmt: skip
        test = Path(name) / "Lathe 3"
        test.mkdir()
        pd.DataFrame(columns).round(4).to_csv(test / "lathe.csv", index=False)
        with open_app(test) as address, open_page(browser, address, 735) as page:
            page.set_default_timeout(_LOADING_MS)
            place = page.get_by_text("Columns of the record")
            place.wait_for()
            place.evaluate("element => element.scrollIntoView({block: 'start'})")
            page.wait_for_timeout(3000)
            keep(folder / "table.png", page)


if __name__ == "__main__":
    results, campaign, pictures = (Path(one) for one in sys.argv[1:] if not one.startswith("--"))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        take_report(browser, results / "report.html", pictures)
        take_app(browser, campaign, results, pictures)
        take_table(browser, pictures)
        take_thermograms(browser, pictures)
        take_gallery(browser, pictures)
        browser.close()
    if _stale:
        raise SystemExit(
            f"pages say something else than their pictures: {', '.join(_stale)}; make screenshots takes them again"
        )
