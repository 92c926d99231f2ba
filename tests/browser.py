"""A headless chromium, and what goes wrong in the pages that it opens."""

import shutil
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def record_faults(page: Any, faults: list[str], *, own: tuple[str, ...]) -> None:
    """Note errors of scripts and of the console, and requests for anything but a page's own addresses."""
    page.on("pageerror", lambda error: faults.append(f"page error: {error}"))
    page.on("console", lambda message: faults.append(f"console: {message.text}") if message.type == "error" else None)
    page.on(
        "request", lambda request: None if request.url.startswith(own) else faults.append(f"request: {request.url}")
    )
