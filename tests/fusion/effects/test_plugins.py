"""Effects of other distributions: who brought them is known, what cannot be used is named, and they can be left out."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from fusion.effects import plugins as module
from fusion.effects.library import library
from fusion.effects.plugins import Plugin, PluginError, describe_code, leave_plugins_out, load_plugin, plugins


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A distribution with three effects: a usable one, one that fails on import, and one that is none."""
    (tmp_path / "machine_effects.py").write_text(
        "from fusion import Effect\nbed = Effect('bed_bending', '', '', lambda readings, coefficients, near: iter(()))\nnumber = 3\n"
    )
    (tmp_path / "broken_effects.py").write_text("raise RuntimeError('no licence')\n")
    info = tmp_path / "machine_effects-1.4.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: machine-effects\nVersion: 1.4\n")
    (info / "entry_points.txt").write_text("[thermofuse.effects]\nbed_bending = machine_effects:bed\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delenv("THERMOFUSE_NO_PLUGINS", raising=False)
    yield tmp_path


def test_an_effect_of_another_distribution_is_listed_with_its_version_and_used(installed: Path) -> None:
    (added,) = plugins()
    assert added == Plugin("bed_bending", "machine_effects:bed", "machine-effects", "1.4")
    assert "bed_bending" in library()


def test_the_code_of_a_plug_in_is_found_without_importing_it(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "machine_effects", raising=False)
    (described,) = describe_code(module.GROUP)
    assert described["version"] == "1.4" and described["code"] == [installed / "machine_effects.py"]
    assert "machine_effects" not in sys.modules
    package = installed / "bed_effects"
    (package / "__pycache__").mkdir(parents=True)
    for name in ("__init__.py", "shapes.csv", "__pycache__/shapes.pyc"):
        (package / name).write_text("raise RuntimeError\n")
    points = [EntryPoint("bed", origin, module.GROUP) for origin in ("bed_effects.plates:bed", "absent_module:bed")]
    monkeypatch.setattr(module, "entry_points", lambda group: points)
    of_package, of_none = describe_code(module.GROUP)
    assert of_package["code"] == [package / "__init__.py", package / "shapes.csv"]
    assert of_none["code"] == [] and of_none["distribution"] == "unknown"


def test_plugins_are_left_out_here_and_in_processes_started_from_here(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("THERMOFUSE_NO_PLUGINS", "")
    assert plugins()
    leave_plugins_out()
    assert plugins() == {} and "bed_bending" not in library()


@pytest.mark.parametrize(
    ("origin", "why"),
    [
        ("broken_effects:bed", "cannot be loaded (RuntimeError: no licence)"),
        ("machine_effects:number", "is a int, not a fusion.Effect"),
        ("absent_module:bed", "cannot be loaded (ModuleNotFoundError: No module named 'absent_module')"),
    ],
)
def test_an_effect_that_cannot_be_used_is_named_with_its_distribution(installed: Path, origin: str, why: str) -> None:
    plugin = Plugin("bed_bending", origin, "machine-effects", "1.4")
    with pytest.raises(PluginError) as error:
        load_plugin(plugin, EntryPoint("bed_bending", origin, module.GROUP))
    assert str(error.value) == (
        f"the effect bed_bending ({origin}) of machine-effects 1.4 {why}; "
        "correct or uninstall that distribution, or add --no-plugins"
    )
