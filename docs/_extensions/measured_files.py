"""Tutorials on measured files: where a file cannot be had, the page is built without being run, and says so.

Such a page lists its files in its front matter, under their names in `data/registry.csv`::

    measured_files:
      - gtatters__Thermimage/inst/extdata/IR_2412.jpg
"""

from __future__ import annotations

from pathlib import Path

import yaml
from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.util import logging

from fusion.campaign.remote import DatasetError, fetch_sample

_logger = logging.getLogger(__name__)
_NOTE = """
:::{{warning}}
This page was **not executed** when it was built: {reason}. Its code is complete; what it prints is missing.
:::
"""


def front_matter(text: str) -> dict[str, object]:
    """Return the front matter of a page, empty where it has none."""
    if not text.startswith("---\n"):
        return {}
    return yaml.safe_load(text.split("---\n", 2)[1]) or {}


def why_not(text: str) -> str:
    """Say which file of a page cannot be had; empty where all can."""
    for name in front_matter(text).get("measured_files", []):  # type: ignore[attr-defined]
        try:
            fetch_sample(name)
        except DatasetError as error:
            _logger.info("not executed: %s", error)
            return f"`{name}` could not be had"
    return ""


def leave_out(app: Sphinx, config: Config) -> None:
    """Take pages whose files cannot be had out of those that are run."""
    pages = {}
    if config.nb_execution_mode != "off":
        for path in sorted(Path(app.srcdir, "tutorials").glob("*.md")):
            reason = why_not(path.read_text(encoding="utf-8"))
            if reason:
                pages[f"tutorials/{path.stem}"] = reason
    config.nb_execution_excludepatterns = [*config.nb_execution_excludepatterns, *(f"{page}.md" for page in pages)]
    app.not_executed = pages  # type: ignore[attr-defined]


def say_so(app: Sphinx, page: str, source: list[str]) -> None:
    """Put the warning below the title of a page that is not run."""
    runs = "{code-cell}" in source[0]
    left_out: dict[str, str] = app.not_executed  # type: ignore[attr-defined]
    reason = "execution was switched off" if runs and app.config.nb_execution_mode == "off" else left_out.get(page, "")
    if reason:
        head, title, rest = source[0].partition("\n# ")
        line, _, body = rest.partition("\n")
        source[0] = f"{head}{title}{line}\n{_NOTE.format(reason=reason)}{body}"


def setup(app: Sphinx) -> dict[str, bool]:
    """Look for the files once, before any page is read."""
    app.connect("config-inited", leave_out)
    app.connect("source-read", say_so)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
