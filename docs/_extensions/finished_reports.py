"""The finished reports of the gallery, made by the commands that a user types, and kept until the program changes.

``{report}`NAME``` is a link to one, or says why it was not made.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.util import logging

from fusion.campaign.remote import DatasetError, fetch_sample, read_registry

_ROOT = Path(__file__).resolve().parents[2]
#: What `html_extra_path` copies into the site, and where the reports are made.
_SITE, _WORK = _ROOT / "build" / "docs-reports", _ROOT / "build" / "docs-campaigns"
_INIT_AND_RUN = (("init", ".", "--yes"), ("run", "campaign.toml", "--quiet"))
#: Name of the report -> part of the names of its public files, the commands, and the file that they write.
REPORTS = {
    "demo": ("", (("demo", "demo"),), "demo/results/report.html"),
    "spindle": ("CAIVIAC__FL_THERMAL", _INIT_AND_RUN, "results/report.html"),
    "iso230": ("target_x.md_ISO230.dat", (("iso230", "target_x.md_ISO230.dat", "--out", "sheet.html"),), "sheet.html"),
    "thermogram": ("FLIR_E40.jpg", _INIT_AND_RUN, "results/report.html"),
    "heated-part": ("ThermalImageFitter", _INIT_AND_RUN, "results/report.html"),
}
_logger = logging.getLogger(__name__)


def newest_source() -> float:
    """Return when the program was last changed."""
    folders = ("thermofuse", "thermography", "interferometry", "fusion", "data")
    return max(file.stat().st_mtime for folder in folders for file in (_ROOT / folder).rglob("*.*"))


def make_report(name: str, samples: str, commands: Iterable[tuple[str, ...]], made: str) -> None:
    """Fetch the files of a report, run its commands and put the report where the site takes it from."""
    folder = _WORK / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for sample in (one for one in read_registry() if samples and samples in one):
        shutil.copy(fetch_sample(sample), folder / sample.rpartition("/")[2])
    for command in commands:
        subprocess.run(
            [sys.executable, "-m", "thermofuse", *command], cwd=folder, check=True, stdout=subprocess.DEVNULL
        )
    shutil.copy(folder / made, _SITE / "reports" / f"{name}.html")


def make_reports(app: Sphinx, config: Config) -> None:
    """Make the reports that are missing or older than the program."""
    app.reports_not_made = {}  # type: ignore[attr-defined]
    (_SITE / "reports").mkdir(parents=True, exist_ok=True)
    for name, how in REPORTS.items():
        path = _SITE / "reports" / f"{name}.html"
        if path.exists() and path.stat().st_mtime > newest_source():
            continue
        path.unlink(missing_ok=True)
        if config.nb_execution_mode == "off":
            app.reports_not_made[name] = "execution was switched off"  # type: ignore[attr-defined]
            continue
        try:
            make_report(name, *how)
        except DatasetError as error:
            _logger.info("report not made: %s", error)
            app.reports_not_made[name] = "a public file could not be had"  # type: ignore[attr-defined]
    config.html_extra_path = [*config.html_extra_path, str(_SITE)]


def setup(app: Sphinx) -> dict[str, bool]:
    """Make the reports before any page is read, and define the role."""

    def link(role: str, raw: str, name: str, *_: Any, **__: Any) -> tuple[list[nodes.Node], list[nodes.Node]]:
        """Return the link to a report of `REPORTS`."""
        if name not in REPORTS:
            raise ValueError(f"no such report: {name}")
        if reason := app.reports_not_made.get(name):  # type: ignore[attr-defined]
            return [nodes.emphasis(raw, f"not made when this site was built: {reason}")], []
        return [nodes.reference(raw, "Open the report", refuri=f"reports/{name}.html")], []

    app.connect("config-inited", make_reports)
    app.add_role("report", link)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
