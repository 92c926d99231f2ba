"""Charts as a page takes them in: models of BokehJS, what embeds them, and the scripts that draw them there."""

from __future__ import annotations

import gzip
import math
from base64 import b64encode
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import metadata, resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

# Models of BokehJS as a page takes them in, written without the library in Python, which takes ten times as long to make them.

#: Numbers that JSON does not know, as BokehJS writes them.
_NOT_FINITE = {"nan": "nan", "inf": "+inf", "-inf": "-inf"}


class Model:
    """A model of BokehJS: its name, and those of its properties that differ from their defaults, which are also its attributes."""

    def __init__(self, kind: str, /, **properties: Any) -> None:
        self.__dict__.update(kind=kind, properties=properties)

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["properties"][name]
        except KeyError:
            raise AttributeError(f"{self.__dict__.get('kind')} has no {name} of its own") from None

    def __setattr__(self, name: str, value: Any) -> None:
        self.properties[name] = value

    def update(self, **properties: Any) -> None:
        """Set properties."""
        self.properties.update(properties)


class Figure(Model):
    """A chart with its axes, its grid and its legend."""

    @property
    def xaxis(self) -> Model:
        """The axis below the data."""
        return self.properties["below"][0]

    @property
    def yaxis(self) -> Model:
        """The axis on the left."""
        return self.properties["left"][0]

    @property
    def legend(self) -> Model:
        """The names above the data."""
        return self.properties["above"][0]

    def set_grid(self, **looks: Any) -> None:
        """Set properties of the lines in both directions."""
        for grid in self.properties["center"][:2]:
            grid.update(**looks)

    def add(self, part: Model, place: str = "center") -> None:
        """Put a part at a place of the chart."""
        self.properties.setdefault(place, []).append(part)


def field(column: str) -> dict[str, str]:
    """Return the value of a property that a column of the data holds."""
    return {"type": "field", "field": column}


def source(columns: Mapping[str, Any]) -> Model:
    """Return columns of data."""
    return Model("ColumnDataSource", data=dict(columns))


def document(root: Model, names: str = "p") -> dict[str, Any]:
    """Return a document of one model as JSON, in the format of ``Document.to_json`` of Bokeh 3; models are called `names` and a number."""
    known: dict[int, str] = {}

    def encode(value: Any) -> Any:
        if not isinstance(value, Model):
            return _encoded(value, encode)
        # A model that was written before is named.
        if (name := known.get(id(value))) is not None:
            return {"id": name}
        name = known[id(value)] = f"{names}{len(known)}"
        attributes = {key: encode(one) for key, one in value.properties.items()}
        return {"type": "object", "name": value.kind, "id": name, "attributes": attributes}

    config = Model("DocumentConfig", notifications=Model("Notifications"))
    parts = {"config": encode(config), "roots": [encode(root)]}
    return {"version": _version(), "title": "", **parts}


@cache
def _version() -> str:
    return metadata.version("bokeh")


def _encoded(value: Any, encode: Callable[[Any], Any]) -> Any:
    """Return a value that is no model in the notation of BokehJS, what it holds by `encode`."""
    if isinstance(value, str | bool | int | None):
        return value
    if isinstance(value, np.generic | np.ndarray) and value.dtype.kind == "M":
        # Milliseconds since 1970.
        value = value.astype("datetime64[us]").astype(float) / 1000.0
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, np.generic):
        return encode(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else {"type": "number", "value": _NOT_FINITE[str(value)]}
    if isinstance(value, Mapping):
        if "type" in value:
            return dict(value)
        return {"type": "map", "entries": [[encode(key), encode(one)] for key, one in value.items()]}
    return [encode(one) for one in value]


def _array(values: np.ndarray) -> Any:
    """Return numbers as compressed bytes, anything else as a list."""
    if values.dtype.kind not in "fiu":
        return values.tolist()
    if values.dtype.kind in "iu" and values.dtype.itemsize > 2:
        values = values.astype(np.int32)
    packed = gzip.compress(np.ascontiguousarray(values).tobytes(), compresslevel=6, mtime=0)
    content = {"type": "bytes", "data": b64encode(packed).decode()}
    return {
        "type": "ndarray",
        "array": content,
        "shape": list(values.shape),
        "dtype": values.dtype.name,
        "order": "little",
    }


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
