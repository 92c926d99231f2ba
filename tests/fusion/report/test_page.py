"""A page is one file: scripts only where it has charts, every variable escaped."""

from __future__ import annotations

from pathlib import Path

import jinja2
import pytest
from markupsafe import Markup

from fusion.report.page import render_page


def test_a_page_needs_the_variables_of_its_template() -> None:
    with pytest.raises(jinja2.UndefinedError, match="results"):
        render_page("report.html.j2", {})


def test_names_do_not_turn_the_direction_of_what_stands_beside_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "templates").mkdir()
    (tmp_path / "templates" / "page.js").write_text("")
    (tmp_path / "templates" / "a.j2").write_text(
        '{% macro cell(text) %}<td title="{{ text }}">{{ text }}</td>{% endmacro %}{{ cell(name) }}{{ own }}{{ count }}'
    )
    monkeypatch.setattr("fusion.report.page.resources.files", lambda package: tmp_path)
    page = render_page("a.j2", {}, name="x\u202egpj.\n<b>\x1b[2J", own=Markup("<i>\u2192</i>"), count=3)
    assert (
        page
        == r"""<td title="x\u202egpj.
&lt;b&gt;\x1b[2J">x\u202egpj.
&lt;b&gt;\x1b[2J</td><i>→</i>3"""
    )
