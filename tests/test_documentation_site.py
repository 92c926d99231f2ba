"""The documentation site builds without a warning, every page is reached, and nothing on it is loaded from elsewhere.

The pages of most modules and the runs of the tutorials are left out: `make docs` has them.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.long, pytest.mark.docs]

ROOT = Path(__file__).resolve().parents[1]
#: What makes a browser load something at once, as opposed to a link.
LOADED = re.compile(
    r"""<(?:script|img|iframe|source|embed)\b[^>]*?\bsrc=["'](.*?)["']|<link\b[^>]*?\bhref=["'](.*?)["']|@import\s+["'](.*?)["']|url\(["']?(.*?)["']?\)"""
)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site in a folder of its own; any warning of Sphinx fails here, as of pages without a place in the contents."""
    out = tmp_path_factory.mktemp("site")
    options = ["--fail-on-warning", "--keep-going", "--quiet", "--tag", "few_modules"]
    command = [
        sys.executable,
        "-m",
        "sphinx",
        *options,
        "-d",
        str(out / "doctrees"),
        str(ROOT / "docs"),
        str(out / "html"),
    ]
    environment = os.environ | {"THERMOFUSE_DOCS_EXECUTION": "off"}
    built = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT, check=False)
    assert built.returncode == 0, built.stderr
    return out / "html"


def test_nothing_is_loaded_from_a_network(site):
    outside = []
    for file in [*site.rglob("*.html"), *site.rglob("*.css")]:
        found = [name for names in LOADED.findall(file.read_text(encoding="utf-8")) for name in names]
        outside += [f"{file.name}: {name}" for name in found if re.match(r"(?:\w+:)?//", name)]
    assert not outside, outside[:10]


def test_every_page_is_there_and_a_tutorial_that_was_not_run_says_so(site):
    pages = {
        page.relative_to(ROOT / "docs").with_suffix(".html")
        for page in (ROOT / "docs").rglob("*.md")
        if "_generated" not in page.parts
    }
    assert pages <= {page.relative_to(site) for page in site.rglob("*.html")}
    for page in sorted((ROOT / "docs/tutorials").glob("*.md")):
        runs = "{code-cell}" in page.read_text(encoding="utf-8")
        text = (site / "tutorials" / f"{page.stem}.html").read_text(encoding="utf-8")
        assert ("<strong>not executed</strong>" in text) is runs


def test_equations_are_drawn_by_a_script_of_the_site(site):
    page = (site / "method/radiometry.html").read_text(encoding="utf-8")
    assert r"\frac{R_1}" in page
    # The smaller tex-svg.js draws no equation of a page that holds \boldsymbol: it fetches that from a file which the site lacks.
    (script,) = re.findall(r'src="\.\./_static/(tex-svg-full\.js)', page)
    assert (site / "_static" / script).stat().st_size > 1e6


def test_reference_comes_from_the_models_and_the_command(site):
    assert "camera_scale_u" in (site / "reference/campaign-file.html").read_text(encoding="utf-8")
    assert "held-out error" in (site / "start/reading-a-report.html").read_text(encoding="utf-8")
    assert "--no-plugins" in (site / "reference/command.html").read_text(encoding="utf-8")
    assert "cross_rmse_before_um" in (site / "reference/results.html").read_text(encoding="utf-8")
    assert "unseen_heat_source" in (site / "reference/recipe.html").read_text(encoding="utf-8")
