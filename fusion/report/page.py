"""Pages: the template, the charts in it and the scripts that draw them, as one file that needs no other and no network."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from typing import Any

import jinja2
from markupsafe import Markup

from fusion.report.charts.embedding import chart_scripts, embed
from fusion.report.charts.style import Chart
from fusion.report.wording import number


def render_page(template: str, charts: Mapping[str, Chart], **context: Any) -> str:
    """Return a page as HTML text.

    Parameters
    ----------
    template : str
        Name of a template in ``fusion/report/templates``.
    charts : mapping of str to Chart
        By the name with which the template calls ``draw``; names that it calls and that are not here leave no trace.
    **context
        Further variables of the template.

    Returns
    -------
    str
        One HTML page. Every variable is escaped where it is shown.
    """
    loader = jinja2.FileSystemLoader(str(resources.files("fusion.report") / "templates"))
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"number": number, "css_string": _css_string}
    return environment.get_template(template).render(
        figures=embed(charts), chart_scripts=chart_scripts() if charts else "", **context
    )


def _css_string(text: str) -> Markup:
    """Return a text as a string of CSS that can neither end the string nor the style element."""
    return Markup(
        '"' + "".join(sign if sign.isalnum() or sign in " ,.-" else f"\\{ord(sign):x} " for sign in text) + '"'
    )
