"""report.html: one self-contained file, made from the products alone."""

from __future__ import annotations

import base64
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

from markupsafe import Markup

from fusion.common import FusionError
from fusion.report.campaign import describe_campaign
from fusion.report.charts.embedded import Drawn, EmbeddedChart, chart_scripts
from fusion.report.wording import TEMPLATES, environment
from fusion.results.loop import RecordLoop
from fusion.results.results import Results, read_results
from fusion.results.store import (
    has_product,
    is_file_list,
    read_fusion,
    read_product,
    read_provenance,
    write_atomically,
    write_text,
)

# Pages: the template, the charts in it and the scripts that draw them, as one file that needs no other and no
# network.


def render_page(
    template: str, charts: Mapping[str, EmbeddedChart], also: tuple[str, ...] = (), /, **context: Any
) -> str:
    """Return a page as HTML text; `also` names scripts of its own."""
    own = tuple(Markup((TEMPLATES / name).read_text(encoding="utf-8")) for name in ("page.js", *also))
    scripts = (*chart_scripts(), *own) if charts else own
    shared = {"figures": dict(charts), "scripts": scripts, "policy": content_security_policy(scripts)}
    return environment(html=True).get_template(template).render(**shared, css_string=_css_string, **context)


def content_security_policy(scripts: Sequence[str]) -> Markup:
    """Return what a browser may do with a page: run these scripts, draw, and nothing else; above all, load nothing.

    Content Security Policy Level 3, W3C Working Draft, sections 6.1 (directives) and 8.3 (hashes of scripts). Styles may stand in the
    page because the charts make theirs while they are drawn.
    """
    hashes = (base64.b64encode(sha256(text.encode()).digest()).decode() for text in scripts)
    allowed = " ".join(f"'sha256-{one}'" for one in hashes)
    rest = "style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'"
    return Markup(f"default-src 'none'; script-src {allowed}; {rest}")


def _css_string(text: str) -> Markup:
    """Return a text as a string of CSS that can neither end the string nor the style element."""
    signs = (sign if sign.isalnum() or sign in " ,.-" else f"\\{ord(sign):x} " for sign in text)
    return Markup(f'"{"".join(signs)}"')


#: Products that a report draws, where a campaign has them.
_DRAWN = ("thermograms", "fields", "deviations", "fusion", "sensors")


class ProductsError(FusionError):
    """A folder that does not hold the products of a finished run."""


def render_report(
    results: Results,
    provenance: Mapping[str, Any],
    datasets: Mapping[str, Any],
    *,
    joint: Mapping[str, Any] | None = None,
    drawn: Callable[[], Drawn] | None = None,
) -> str:
    """Return the report of a run as HTML text.

    Parameters
    ----------
    results : Results
        Results of the run, see `fusion.results.results.read_results`.
    provenance : mapping
        Content of provenance.json.
    datasets : mapping
        ``fields`` and ``deviations`` (Dataset) and ``fusion`` (DataTree) as they were written; those that a campaign does not
        have may be absent. A ``record`` (Dataset) stands alone.
    joint : mapping, optional
        What this campaign and another one of the machine agree on: ``other`` (what the other is called), and what
        `fusion.report.comparison.describe_places` returns.
    drawn : callable, optional
        Returns the charts of a campaign as `fusion.report.charts.campaign.draw_campaign` does, where another process draws them; called
        when everything else is written. Left out: they are drawn here.

    Returns
    -------
    str
        One HTML page that needs no other file and no network.

    Raises
    ------
    KeyError
        If the products lack what the results refer to, because they belong to different runs.

    Notes
    -----
    Maps that exceed three million values are thinned in cycles and averaged in cells, and the page says so. Terms of
    ISO 230-2:2014; expanded uncertainties with k = 2 (GUM 6.2).

    Examples
    --------
    >>> from pathlib import Path
    >>> page = render_report(read_results(Path("results")), provenance, datasets)  # doctest: +SKIP
    """
    if drawn is None:
        # Its library is loaded where charts are made.
        from fusion.report.charts.campaign import draw_campaign

        drawn = partial(draw_campaign, results, datasets)
    summary = describe_campaign(results, provenance, datasets, joint)
    charts, thermal_map = drawn()
    found = {"results": results, "provenance": provenance, "summary": summary, "thermal_map": thermal_map}
    return render_page("report.html.j2", charts, **found)


def report_of(folder: Path, *, joint: Mapping[str, Any] | None = None) -> str:
    """Return the report of a finished run, made again from its products; `joint` as in `render_report`."""
    results = read_results(folder)
    provenance, again = read_provenance(folder), "run the campaign again, with --resume to keep what is finished"
    if not _is_provenance(provenance):
        fault = ": not the provenance of a run" if provenance else " is missing"
        raise ProductsError(f"{folder / 'provenance.json'}{fault}; {again}")
    if isinstance(results.loop, RecordLoop):
        return render_report(results, provenance, {"record": read_product(folder, "record")})
    there = [name for name in _DRAWN if has_product(folder, f"{name}.nc")]
    read = {name: read_fusion(folder) if name == "fusion" else read_product(folder, name) for name in there}
    try:
        return render_report(results, provenance, read, joint=joint)
    except KeyError as error:
        raise ProductsError(
            f"{folder}: the products lack what results.json refers to ({error}), as those of different runs; put the files back, or {again}"
        ) from error


def _is_provenance(content: Any) -> bool:
    """Whether JSON holds what a report tells of a run's origin: its times and command, inputs, versions and parameters."""
    needed = {"started": str, "finished": str, "command": list, "versions": dict, "parameters": dict}
    if not (isinstance(content, dict) and all(isinstance(content.get(key), kind) for key, kind in needed.items())):
        return False
    tables = content["parameters"]
    complete = "campaign" in tables and all(isinstance(table, dict) for table in tables.values())
    return complete and "thermofuse" in content["versions"] and is_file_list(content.get("inputs"))


# A report on paper: printed to PDF by an installed browser.

#: Commands of the browsers that can print without a window, in the order in which they are looked for.
_COMMANDS = (
    "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge", "microsoft-edge-stable", "msedge",
    "brave-browser",
)  # fmt: skip
#: Where they are installed without being on the path: macOS and Windows.
_PLACES = (
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
    "/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge",
    r"C:\Program Files\Google\Chrome\Application\chrome.exe",
    r"C:\Program Files (x86)\Google\Chrome\Application\chrome.exe",
    r"C:\Program Files (x86)\Microsoft\Edge\Application\msedge.exe",
    r"C:\Program Files\Microsoft\Edge\Application\msedge.exe",
)
_LONGEST_S = 180


class PrintError(FusionError):
    """A report cannot be printed to PDF."""


def find_browser(named: str | None = None) -> str:
    """Return the browser that prints."""
    for candidate in (*_COMMANDS, *_PLACES) if named is None else (named,):
        if (found := shutil.which(candidate)) is not None:
            return found
    if named is not None:
        raise PrintError(f'--browser "{named}": there is no such program; name the file of Chrome, Chromium or Edge')
    raise PrintError(
        "no browser that can print was found (looked for Chromium, Chrome, Edge and Brave); install one, name it with --browser FILE, or "
        "open report.html and press its button Print"
    )


class PageFileError(FusionError):
    """A page that cannot be written to the file that was named; the message says why."""


def page_format(path: Path, *formats: str) -> str:
    """Return the format that a file's name asks for, one of those given; the file must not exist."""
    if path.exists():
        raise PageFileError(f"{path} exists already; name another file with --out, or remove it")
    asked = ".html" if path.suffix.lower() == ".htm" else path.suffix.lower()
    if asked not in formats:
        written = " or ".join(filter(None, (", ".join(formats[:-1]), formats[-1])))
        raise PageFileError(f"{path}: it is written as {written}; name such a file with --out")
    return asked


def write_page(path: Path, page: str) -> None:
    """Write a page as HTML or PDF; nothing is replaced."""
    if page_format(path, ".html", ".pdf") == ".pdf":
        print_pdf(page, path)
    else:
        write_text(path, page)


def print_pdf(page: str, out: Path, *, browser: str | None = None) -> Path:
    """Print a page to a PDF file, with everything that is folded on the screen."""
    program = find_browser(browser)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "report.html"
        file.write_text(page, encoding="utf-8")
        address = f"{file.as_uri()}#on-a4"
        return write_atomically(out, lambda temporary: _print(program, address, temporary, folder))


def _print(program: str, address: str, out: Path, profile: str) -> None:
    """Run the browser until it has printed."""
    command = [
        program, "--headless", "--disable-gpu", "--no-first-run", "--no-pdf-header-footer", f"--user-data-dir={profile}/profile",
        "--window-size=1000,1400", "--virtual-time-budget=60000", f"--print-to-pdf={out.resolve()}", address,
    ]  # fmt: skip
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        command.insert(1, "--no-sandbox")  # a browser refuses to run for root with its sandbox
    # What the browser leaves goes with the folder; where it would write else may not exist.
    environment = os.environ | dict.fromkeys(("TMPDIR", "TEMP", "TMP"), profile)
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST_S, check=False, env=environment)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PrintError(f"{program} did not print: {error}; name another browser with --browser FILE") from error
    if done.returncode or not out.exists() or not out.stat().st_size:
        said = done.stderr.strip().splitlines()
        raise PrintError(
            f"{program} ended with {done.returncode} and printed nothing{': ' + said[-1] if said else ''}; name another browser with "
            "--browser FILE"
        )
