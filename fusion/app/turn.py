"""Changes of a page in order: one message after another, each when the document may be changed."""

from __future__ import annotations

from collections.abc import Callable

import panel as pn


def in_turn(change: Callable[[], None]) -> None:
    """Change what a page shows, after every change that was asked for before; at once where no page shows it.

    Parameters
    ----------
    change : callable
        Changes views, widgets or charts of one page; all of it reaches the browser in one message.

    Notes
    -----
    Panel and Bokeh each write messages to the browser, and Panel puts its own off while the connection is busy: the change of a chart
    that Bokeh writes could then arrive before the message that brings the chart. Here both go through Panel's queue.
    """

    def together() -> None:
        with pn.io.unlocked():
            change()

    pn.state.execute(together, schedule=True)
