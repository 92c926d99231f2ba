"""A page is one file: scripts only where it has charts, every variable escaped."""

from __future__ import annotations

import jinja2
import pytest

from fusion.report.page import render_page


def test_a_page_needs_the_variables_of_its_template() -> None:
    with pytest.raises(jinja2.UndefinedError, match="results"):
        render_page("report.html.j2", {})
