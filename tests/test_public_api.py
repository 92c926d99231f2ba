"""The public names: importable, documented for a user, with examples that run; and the share of documented functions everywhere."""

import ast
import doctest
import importlib
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import BaseModel

import thermofuse

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("thermography", "interferometry", "fusion")
PUBLIC = [(package, name) for package in PACKAGES for name in importlib.import_module(package).__all__]
#: Words by which a docstring names its source: an equation, a paper, a clause of a standard, or a page of the method.
SOURCES = ("Notes", "References")


def described_parameters(docstring: str) -> set[str]:
    """Names that the Parameters section of a numpy docstring describes, stars removed; empty without an underlined heading."""
    _, heading, rest = docstring.partition("\nParameters\n----------\n")
    section = re.split(r"\n\n\w[\w ]*\n---", rest)[0] if heading else ""
    # A name begins its line, and what describes it is indented.
    entries = re.findall(r"^([*\w].*?)(?: : .*)?\n +\S|^([*\w].*?) : ", section, flags=re.MULTILINE)
    return {name.strip(" *") for entry in entries for name in "".join(entry).split(",")}


def test_described_parameters_are_those_of_an_underlined_section():
    text = """Do it.

    Parameters
    ----------
    a, b : float
        Lengths, mm; c is explained elsewhere.
    **options
        Passed on.
    budget : Iso230Budget

    Returns
    -------
    total : float
        Their sum."""
    assert described_parameters(inspect.cleandoc(text)) == {"a", "b", "options", "budget"}
    assert described_parameters(inspect.cleandoc(text.replace("    ----------\n", ""))) == set()


def lacks(thing: object) -> list[str]:
    """What the docstring of a public name does not say."""
    text = inspect.getdoc(thing) or ""
    if inspect.isclass(thing):
        # An error has a message, a record has attributes with units, a model describes each field beside it.
        described = issubclass(thing, BaseModel) and all(
            "description" in key for key in thing.model_json_schema()["properties"].values()
        )
        told = issubclass(thing, Exception) or "Attributes" in text or "Parameters" in text or described
        return [] if text and told else ["its attributes"]
    signature = inspect.signature(thing)
    headings = ["Parameters"] if signature.parameters else []
    if "raise " in inspect.getsource(thing):
        headings.append("Raises")
    if signature.return_annotation not in (None, "None"):
        headings.append("Returns")
    missing = [heading for heading in headings if f"\n{heading}\n---" not in text]
    missing += [] if any(f"\n{heading}\n---" in text for heading in SOURCES) else ["its source"]
    return missing + [name for name in signature.parameters if name not in described_parameters(text)]


def test_a_public_name_is_documented_for_a_user():
    found = {name: lacks(getattr(importlib.import_module(package), name)) for package, name in PUBLIC}
    assert len(found) > 60 and {name: lacking for name, lacking in found.items() if lacking} == {}


def test_the_root_module_re_exports_names_of_the_packages():
    for name in thermofuse.__all__:
        thing = getattr(thermofuse, name)
        assert any(getattr(importlib.import_module(package), name, None) is thing for package in PACKAGES), name
    assert sorted([*thermofuse.__all__, "__version__"]) == dir(thermofuse)
    assert thermofuse.__version__.count(".") == 2
    with pytest.raises(AttributeError, match="module 'thermofuse' has no attribute 'nothing'"):
        thermofuse.nothing  # noqa: B018


@pytest.mark.long
def test_each_package_has_one_error_base_class():
    for package, base in zip(PACKAGES, ("ThermographyError", "InterferometryError", "FusionError"), strict=True):
        root = getattr(importlib.import_module(package), base)
        assert issubclass(root, ValueError)
        for path in (ROOT / package).rglob("*.py"):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef) and node.name.endswith("Error") and node.bases:
                    thing = getattr(importlib.import_module(module), node.name)
                    # A record of what went wrong is no exception, whatever its name.
                    assert not issubclass(thing, Exception) or issubclass(thing, root), f"{module}.{node.name}"


def modules_with_examples() -> list[str]:
    """Modules whose docstrings hold an example."""
    paths = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    return sorted(
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in paths
        if ">>> " in path.read_text(encoding="utf-8")
    )


@pytest.mark.long
@pytest.mark.parametrize("module", modules_with_examples())
def test_examples_in_docstrings_run(module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(
        importlib.import_module(module), optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    )
    assert result.attempted > 0
    assert result.failed == 0


def test_importing_the_packages_is_quick_because_it_imports_nothing_large():
    large = {"numpy", "xarray", "cv2", "numba", "matplotlib"}
    code = f"import sys, {', '.join(PACKAGES)}, thermofuse; print(sorted({large!r} & set(sys.modules)))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.strip() == "[]"
