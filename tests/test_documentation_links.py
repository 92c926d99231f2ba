"""The method pages and the code do not drift apart: pages, modules, files and tests named in either exist, and quoted constants hold.

A page quotes a constant as ``module.NAME = value``, the default of an argument as ``module.function(argument) = value``, both in backticks.
"""

import ast
import importlib
import importlib.util
import inspect
import re
import subprocess
from collections.abc import Iterator
from datetime import date
from difflib import get_close_matches
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from fusion.analysis.consistency import RULES
from fusion.campaign.remote import read_registry
from tests.readme import measured_files

ROOT = Path(__file__).resolve().parents[1]
#: Without those that are written from the code when the site is built.
PAGES = sorted(page for page in (ROOT / "docs").rglob("*.md") if "_generated" not in page.parts)
PACKAGES = ("thermography", "interferometry", "fusion")
DOTTED = rf"(?:{'|'.join(PACKAGES)})(?:\.\w+)+"
QUOTED = re.compile(rf"`({DOTTED})(?:\((\w+)\))? = ([^`]+)`")


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def resolve(dotted: str) -> object:
    """The module, or the attribute of a module or class, that a dotted name stands for."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(dotted)


def near(dotted: str) -> str:
    """What the module calls a name that it does not have: the same with or without a leading underscore, or one that looks alike."""
    module, _, name = dotted.rpartition(".")
    try:
        known = dir(resolve(module))
    except (ModuleNotFoundError, AttributeError):
        return ""
    alike = get_close_matches(name, known, n=1)
    return f"; did you mean {module}.{alike[0]}?" if alike else ""


def equal(quoted: object, actual: object) -> bool:
    """Numbers to nine digits, one by one in sequences and mappings; everything else exactly."""
    if isinstance(actual, np.ndarray):
        actual = actual.tolist()
    if isinstance(quoted, dict) and isinstance(actual, dict):
        return quoted.keys() == actual.keys() and all(equal(value, actual[key]) for key, value in quoted.items())
    if isinstance(quoted, (list, tuple)) and isinstance(actual, (list, tuple)):
        return len(quoted) == len(actual) and all(equal(a, b) for a, b in zip(quoted, actual, strict=True))
    if isinstance(quoted, (int, float)) and isinstance(actual, (int, float, np.number)):
        return bool(np.isclose(quoted, float(actual), rtol=1e-9, atol=0.0))
    return quoted == actual


def test_every_quoted_constant_has_the_value_of_the_code():
    wrong = []
    for page, (dotted, argument, text) in in_pages(QUOTED):
        place = f"{page}: {dotted}({argument})" if argument else f"{page}: {dotted}"
        try:
            found = resolve(dotted)
            actual = inspect.signature(found).parameters[argument].default if argument else found
        except (ModuleNotFoundError, AttributeError, KeyError):
            wrong.append(f"{place} does not exist{near(dotted)}")
            continue
        if not equal(ast.literal_eval(text), actual):
            wrong.append(f"{place} is {actual!r}, the page says {text}")
    assert not wrong, "; ".join(wrong)


def in_pages(pattern: re.Pattern[str]) -> Iterator[tuple[str, Any]]:
    """What a pattern finds, with the name of its page."""
    return ((name_of(page), found) for page in PAGES for found in pattern.findall(page.read_text(encoding="utf-8")))


def test_every_module_named_in_a_page_exists():
    missing = []
    for page, dotted in sorted(set(in_pages(re.compile(rf"`({DOTTED})[`(]")))):
        if dotted == "fusion.nc":  # a product
            continue
        try:
            resolve(dotted)
        except (ModuleNotFoundError, AttributeError):
            missing.append(f"{page} names {dotted}{near(dotted)}")
    assert not missing, "; ".join(missing)


def missing_files(text: str) -> list[str]:
    """The files and tests that a text names and that do not exist."""
    missing = []
    for name, test in re.findall(r"(?<![\w/])((?:tests|data|fusion|docs)/[\w./-]*\w)(?:::(\w+))?", text):
        path = ROOT / name
        if not path.exists() or (test and not re.search(rf"^def {test}\(", path.read_text(encoding="utf-8"), re.M)):
            missing.append(f"{name}::{test}" if test else name)
    return missing


def test_every_file_and_test_named_in_a_page_exists() -> None:
    missing = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        links = [link for link in re.findall(r"\]\(([\w./-]+\.md)", text) if not (page.parent / link).exists()]
        missing += [f"{name_of(page)} names {name}" for name in (*missing_files(text), *links)]
    assert not missing, "; ".join(missing)


def test_every_measured_file_of_a_tutorial_is_listed():
    named = {name for page in PAGES for name in measured_files(page.read_text(encoding="utf-8"))}
    assert named and named <= set(read_registry())


def test_every_page_and_test_cited_in_the_code_exists():
    missing = []
    for folder in (*PACKAGES, "tests"):
        for source in sorted((ROOT / folder).rglob("*.py")):
            cited = re.findall(r"(?:docs/[\w/-]+\.md|tests/[\w/]+\.py)", source.read_text(encoding="utf-8"))
            missing += [f"{name_of(source)} cites {name}" for name in cited if not (ROOT / name).exists()]
    assert not missing, "; ".join(missing)


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    """The extension of the site that makes the tables of measured figures."""
    spec = importlib.util.spec_from_file_location("reference_pages", ROOT / "docs/_extensions/reference_pages.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_check_has_a_row_with_its_limits(pages: ModuleType) -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", pages.checks_table(), re.M))
    assert list(rows) == list(RULES)
    assert "`LEAST_TRAVEL_SHARE = 0.03`. | the positions are in mm |" in rows["travel"]
    assert not [code for code, row in rows.items() if len(row.split(" | ")) != 3 or "| |" in row]


def test_every_measured_figure_is_whole_and_its_command_names_tests_that_exist(pages: ModuleType) -> None:
    rows = pages.measured_rows(ROOT / "docs/measured.csv")
    assert len({(row["section"], row["figure"]) for row in rows}) == len(rows)
    wrong = []
    for row in rows:
        if not row["value"] or date.fromisoformat(row["date"]).year < 2026 or max(map(len, row.values())) > 160:
            wrong.append(row["figure"])
        if not re.fullmatch(r"(?:[0-9a-f]{7}(?:, )?)*", row["commit"]):
            wrong.append(f"{row['figure']}: commit {row['commit']}")
        wrong += [f"{row['figure']} cites {name}" for name in missing_files(row["command"])]
    assert not wrong, "; ".join(wrong)


def test_every_commit_of_a_measured_figure_exists(pages: ModuleType) -> None:
    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False).stdout

    if git("rev-parse", "--is-shallow-repository").strip() != "false":
        pytest.skip("the history is not here")
    named = {commit for row in pages.measured_rows(ROOT / "docs/measured.csv") for commit in row["commit"].split(", ")}
    assert named - {""} <= {commit[:7] for commit in git("rev-list", "HEAD").split()}


def test_the_gallery_links_the_reports_that_the_site_makes() -> None:
    linked = re.findall(r"\{report\}`([\w-]+)`", (ROOT / "docs/gallery.md").read_text(encoding="utf-8"))
    made = re.findall(
        r'^    "([\w-]+)": \(', (ROOT / "docs/_extensions/finished_reports.py").read_text(encoding="utf-8"), re.M
    )
    assert sorted(linked) == sorted(made)


def test_the_page_of_measured_figures_is_made_from_them_and_is_short(pages: ModuleType) -> None:
    text = (ROOT / "docs/measured.md").read_text(encoding="utf-8")
    rows = pages.measured_rows(ROOT / "docs/measured.csv")
    assert pages.measured_page(text, rows) == text, "make docs writes the tables anew"
    assert {row["section"] for row in rows} == set(re.findall(r"^## (.*)", text, re.M))
    assert len([word for word in text.split() if word.strip("|-")]) < 2300
