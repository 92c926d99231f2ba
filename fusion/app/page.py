"""The page: a bar of screens above the one that is shown, in the style of the report."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import panel as pn
from panel.theme.base import Design, Inherit
from panel.viewable import Viewable

from fusion.app.compare.screen import compare_screen
from fusion.app.elements import paragraph
from fusion.app.live.screen import live_screen
from fusion.app.results.screen import results_screen
from fusion.app.run.screen import run_screen
from fusion.app.setup.screen import set_up
from fusion.app.state import State, state_of

_TEMPLATES = Path(__file__).parent / "templates"

#: A screen shows a state, and changes it.
Screen = Callable[[State], Viewable]
#: Screens in the order of the work.
SCREENS: dict[str, Screen] = {
    "Set up": set_up,
    "Run": run_screen,
    "Results": results_screen,
    "Compare": compare_screen,
    "Live": live_screen,
}


class Look(Design):
    """Style of every part of a screen: a part sees the page's own rules no more than those of another part."""

    modifiers = {Viewable: {"stylesheets": [Inherit, (_TEMPLATES / "parts.css").read_text(encoding="utf-8")]}}  # noqa: RUF012


def build_page(root: Path) -> Any:
    """Build the page for one tab of a browser.

    Parameters
    ----------
    root : Path
        Folder for which the application was started.

    Returns
    -------
    Template
        Of Panel.
    """
    pn.extension("filedropper")
    state = state_of(root)
    shown: dict[str, Viewable] = {}
    content = pn.Column(sizing_mode="stretch_width", css_classes=["screen"])
    bar = pn.widgets.RadioButtonGroup(
        label="Screens", options=list(SCREENS), sizing_mode="stretch_width", css_classes=["bar"]
    )

    def show(name: str) -> None:
        if name not in shown:
            shown[name] = SCREENS[name](state)
            content.append(shown[name])
        # A chart that is taken out of a page no longer hears clicks when it comes back: the other screens are hidden.
        for other, screen in shown.items():
            screen.visible = other == name

    def choose(name: str) -> None:
        bar.value = state.screen = name
        show(name)

    bar.param.watch(lambda event: choose(event.new), "value")
    state.param.watch(lambda event: choose(event.new), "screen")
    choose(next(iter(SCREENS)))
    page = pn.Template((_TEMPLATES / "page.html.j2").read_text(encoding="utf-8"), design=Look)
    page.add_variable("style", (_TEMPLATES / "page.css").read_text(encoding="utf-8"))
    page.add_variable("names", (_TEMPLATES / "names.js").read_text(encoding="utf-8"))
    page.add_panel("bar", bar)
    page.add_panel("place", paragraph(f"Folder {state.root}", kind="note"))
    page.add_panel("content", content)
    return page
