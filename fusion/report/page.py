"""Pages: the template, the charts in it and the scripts that draw them, as one file that needs no other and no network."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from hashlib import sha256
from importlib import resources
from typing import Any

import jinja2
from markupsafe import Markup

from fusion.report.charts.embedding import EmbeddedChart, chart_scripts
from fusion.report.wording import number
from fusion.terminal import printable


def render_page(template: str, charts: Mapping[str, EmbeddedChart], **context: Any) -> str:
    """Return a page as HTML text.

    Parameters
    ----------
    template : str
        Name of a template in ``fusion/report/templates``.
    charts : mapping of str to EmbeddedChart
        By the name with which the template calls ``draw``; names that it calls and that are not here leave no trace.
    **context
        Further variables of the template.

    Returns
    -------
    str
        One HTML page. Every variable is escaped where it is shown, and what would turn the direction of the text around it is written
        out, as in a terminal.
    """
    templates = resources.files("fusion.report") / "templates"
    loader = jinja2.FileSystemLoader(str(templates))
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined, finalize=_in_page,
    )  # fmt: skip
    environment.filters |= {"number": number, "css_string": _css_string}
    own = Markup((templates / "page.js").read_text(encoding="utf-8"))
    scripts = (*chart_scripts(), own) if charts else (own,)
    return environment.get_template(template).render(
        figures=charts, scripts=scripts, policy=content_security_policy(scripts), **context
    )


def content_security_policy(scripts: Sequence[str]) -> Markup:
    """Return what a browser may do with a page: run these scripts, draw, and nothing else; above all, load nothing.

    Parameters
    ----------
    scripts : sequence of str
        Texts of the page's script elements; any other script in it is not run, wherever it came from.

    Returns
    -------
    Markup
        For a ``meta`` element. Styles may stand in the page because the charts make theirs while they are drawn.

    References
    ----------
    Content Security Policy Level 3, W3C Working Draft, sections 6.1 (directives) and 8.3 (hashes of scripts).

    Examples
    --------
    >>> str(content_security_policy(["start()"])).split("; ")[1]
    "script-src 'sha256-DIm7WJS6ZKDYe5qFLPy+h4JFI9Bol5QmYC57mt3Fb00='"
    """
    hashes = (base64.b64encode(sha256(text.encode()).digest()).decode() for text in scripts)
    allowed = " ".join(f"'sha256-{one}'" for one in hashes)
    rest = "style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'"
    return Markup(f"default-src 'none'; script-src {allowed}; {rest}")


def _in_page(value: object) -> object:
    """Return a text of which no sign acts on what stands beside it; what is HTML already is made of such texts."""
    return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _css_string(text: str) -> Markup:
    """Return a text as a string of CSS that can neither end the string nor the style element."""
    return Markup(
        '"' + "".join(sign if sign.isalnum() or sign in " ,.-" else f"\\{ord(sign):x} " for sign in text) + '"'
    )
