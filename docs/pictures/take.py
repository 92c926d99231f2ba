"""Take the pictures of the report for README and documentation: ``python docs/pictures/take.py RESULTS FOLDER`` (`make screenshots`)."""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

#: A README loads its pictures for every reader.
_MOST_BYTES = 150_000
#: Name of the picture -> what of the report is brought to the top of the window, and the window's height in px.
_PARTS = {"report": ("body", 860), "thermal-map": ("#fields", 760)}


def compact(picture: bytes) -> bytes:
    """Return a PNG with a palette of its own colours; fewer of them until it is small enough."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    for colours in (256, 128, 64):
        small = io.BytesIO()
        image.quantize(colours, dither=Image.Dither.NONE).save(small, "PNG", optimize=True)
        if small.tell() < _MOST_BYTES:
            return small.getvalue()
    raise SystemExit(
        f"a picture of {image.size} px is larger than {_MOST_BYTES} bytes with 64 colours; take less of the page"
    )


def take(report: Path, folder: Path) -> None:
    """Write a picture of every part of a report."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        for name, (place, height) in _PARTS.items():
            page = browser.new_page(viewport={"width": 1200, "height": height}, color_scheme="light")
            page.goto(report.resolve().as_uri())
            page.wait_for_load_state("networkidle")
            page.locator(place).first.evaluate("element => element.scrollIntoView({block: 'start'})")
            page.wait_for_timeout(2000)
            (folder / f"{name}.png").write_bytes(compact(page.screenshot()))
            page.close()
        browser.close()


if __name__ == "__main__":
    results, pictures = map(Path, sys.argv[1:3])
    take(results / "report.html", pictures)
