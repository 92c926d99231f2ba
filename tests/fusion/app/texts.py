"""The texts of parts of a screen."""

from collections.abc import Iterable
from html import unescape

import panel as pn


def texts(parts: Iterable[pn.viewable.Viewable]) -> str:
    """Return all texts of parts of a screen, with markup, as one text."""
    return unescape("\n".join(str(pane.object) for part in parts for pane in part.select(pn.pane.HTML)))
