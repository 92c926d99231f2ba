"""The layout: folders small enough to be read at a glance, modules of one idea, tests where their package is."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("thermography", "interferometry", "fusion")
#: Largest number of modules in a folder and of lines in a module.
MOST_MODULES, MOST_LINES = 15, 700
#: Folders of tests without a package of their own: long runs, asked for by name.
APART = {"benchmarks", "soak"}
#: Modules without a test file of their name: types, errors and packaging, which every test uses.
NO_TEST_OF_THEIR_OWN = {"__init__", "_constants", "_typing", "errors"}
#: Parts of one thing that are tested where they are put together.
TESTED_TOGETHER = {
    "results_attribution",
    "results_axis",
    "results_inputs",
    "results_iso230",
    "results_loop",
    "results_part",
    "results_radiometry",
    "results_record",
}


def modules(package: str) -> list[Path]:
    return sorted(path for path in (ROOT / package).rglob("*.py") if path.stem not in NO_TEST_OF_THEIR_OWN)


@pytest.mark.parametrize("package", PACKAGES)
def test_folders_and_modules_are_small(package: str) -> None:
    for folder in sorted({path.parent for path in modules(package)}):
        count = len([path for path in folder.glob("*.py") if path.stem not in NO_TEST_OF_THEIR_OWN])
        assert count <= MOST_MODULES, f"{folder.relative_to(ROOT)} holds {count} modules"
    for path in modules(package):
        lines = path.read_text(encoding="utf-8").count("\n")
        assert lines <= MOST_LINES, f"{path.relative_to(ROOT)} has {lines} lines"


@pytest.mark.parametrize("package", PACKAGES)
def test_every_module_has_its_test_at_the_mirrored_place(package: str) -> None:
    missing = [
        f"tests/{path.relative_to(ROOT).parent}/test_{path.stem}.py"
        for path in modules(package)
        if path.stem not in TESTED_TOGETHER
        and not (ROOT / "tests" / path.relative_to(ROOT).parent / f"test_{path.stem}.py").exists()
    ]
    assert not missing, f"{len(missing)} missing: {missing}"


def test_folders_of_tests_belong_to_packages() -> None:
    for folder in sorted({path.parent for path in (ROOT / "tests").rglob("test_*.py")} - {ROOT / "tests"}):
        relative = folder.relative_to(ROOT / "tests")
        assert relative.parts[0] in APART or (ROOT / relative).is_dir(), f"{relative} has no package"
