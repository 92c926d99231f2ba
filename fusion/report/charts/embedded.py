"""Charts as a page takes them in, and the scripts that draw them there; the library that makes them is not loaded for it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from markupsafe import Markup


@dataclass(frozen=True)
class EmbeddedChart:
    """A chart as the macro ``draw`` of ``templates/charts.html.j2`` reads it: name, unique in its page; text alternative; CSS px that are
    kept free until it is drawn; Bokeh's document as JSON that may stand in a ``<script>``.
    """

    name: str
    seen: str
    height: int
    item: Markup


class MapControls(NamedTuple):
    """What the reader can choose of the map, a quantity and a cycle, and what the page says was thinned or averaged."""

    quantities: list[str]
    cycles: list[int]
    note: str


class Drawn(NamedTuple):
    """Charts by name as a page takes them in, and what the reader can choose of the thermal map where it is among them."""

    charts: dict[str, EmbeddedChart]
    thermal_map: MapControls | None = None

    def with_more(self, more: Drawn) -> Drawn:
        """Return these charts and others."""
        return Drawn(self.charts | more.charts, more.thermal_map or self.thermal_map)


@cache
def chart_scripts() -> tuple[Markup, ...]:
    """Return BokehJS and what draws the charts, as texts for script elements; once per page, after the last chart."""
    found = find_spec("bokeh")
    assert found is not None and found.origin is not None
    library = (Path(found.origin).parent / "server" / "static" / "js" / "bokeh.min.js").read_text(encoding="utf-8")
    own = (resources.files("fusion.report") / "templates" / "charts.js").read_text(encoding="utf-8")
    return tuple(in_script(text, "</script") for text in (library, own))


def in_script(text: str, closing: str) -> Markup:
    """Return a text that may stand in a script element: nothing in its strings closes the element."""
    return Markup(text.replace(closing, closing.replace("</", "<\\/")))
