"""The screen *Set up* in a browser."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.browser


def test_a_folder_is_looked_into_and_one_outside_is_refused(
    app: tuple[str, Path], new_page: Callable[..., Any]
) -> None:
    page = new_page(app[0])
    page.get_by_text("24 frames of 640 x 480").wait_for()
    field = page.get_by_label("Folder of the measurement")
    field.fill("../outside")
    field.press("Tab")
    page.get_by_role("button", name="Look into it").press("Enter")
    page.get_by_role("alert").get_by_text("lies outside").wait_for()
