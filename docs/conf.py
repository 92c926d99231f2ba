"""Sphinx: how the documentation is built. Nothing is fetched, and a warning is an error (`make docs`)."""

from __future__ import annotations

import os
import sys
from functools import partial
from importlib import metadata
from pathlib import Path

import mathjax
from jupyter_cache.executors import utils as notebook_runs

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "_extensions"))
# What tutorials run: the command of this environment, in lines that fit the page.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
os.environ["COLUMNS"] = "90"
os.environ["TTY_COMPATIBLE"] = "0"
# What a command prints in pieces is joined as it came; myst-nb would begin a line at every piece.
notebook_runs.executenb = partial(notebook_runs.executenb, coalesce_streams=True)
# A progress bar of another library misses its widgets; nothing on these pages would show them.
os.environ["PYTHONWARNINGS"] = "ignore:IProgress not found"

project = "thermofuse"
author = "The thermofuse authors"
version = release = metadata.version("thermofuse")
html_title = f"thermofuse {release}"
copyright = "the thermofuse authors, MIT licence"

extensions = [
    "sphinx.ext.autodoc",
    "numpydoc",
    "myst_nb",
    "sphinx_design",
    "sphinx.ext.mathjax",
    "reference_pages",
    "measured_files",
    "drawings",
    "finished_reports",
]
exclude_patterns = ["reference/_generated"]
if tags.has("few_modules"):  # noqa: F821 - Sphinx puts it there; `sphinx-build -t few_modules` is quick
    exclude_patterns += ["reference/api/[!i]*"]
source_suffix = {".rst": "restructuredtext", ".md": "myst-nb"}
default_role = "literal"
# Own names must resolve. Those of other libraries cannot: their inventories would have to be fetched.
# Private bases and aliases of types have no page.
nitpick_ignore_regex = [
    (r"py:.*", r"(?!thermofuse|thermography|interferometry|fusion).*"),
    (r"py:.*", r".*\._\w+"),
    (r"py:obj", r".*\.(M|Product|Item)"),
]

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 3

autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
numpydoc_show_class_members = False
numpydoc_xref_param_type = False
numpydoc_class_members_toctree = False

# The tutorials are run while the pages are built; THERMOFUSE_DOCS_EXECUTION=off leaves that out (links and references are checked anyway).
nb_execution_mode = "off" if os.environ.get("THERMOFUSE_DOCS_EXECUTION") == "off" else "cache"
nb_execution_cache_path = str(HERE.parent / "build" / "docs-cache")
nb_execution_timeout = 300
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_merge_streams = True
# myst-nb would load the scripts of interactive widgets from a CDN.
nb_ipywidgets_js = {}

html_theme = "pydata_sphinx_theme"
# MathJax that draws equations as SVG is one file and needs no font; the smaller one fetches \boldsymbol from a file of its own.
html_static_path = ["_static", str(Path(mathjax.__file__).parent / "static" / "mathjax" / "es5" / "tex-svg-full.js")]
mathjax_path = "tex-svg-full.js"
html_css_files = ["thermofuse.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {"text": "thermofuse"},
    "navbar_align": "left",
    "navigation_with_keys": False,
    "show_prev_next": True,
    "show_toc_level": 2,
    "navigation_depth": 3,
    "header_links_before_dropdown": 6,
    "footer_start": ["copyright"],
    "footer_end": ["theme-version"],
    "secondary_sidebar_items": ["page-toc"],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
