"""The library as a whole: names, words, and the promise of a declarable effect."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from fusion.analysis.alignment.readings import Readings, Series
from fusion.analysis.effects import library as library_module
from fusion.analysis.effects.effect import Effect
from fusion.analysis.effects.library import (
    LIBRARY,
    PluginError,
    describe_code,
    describe_effect,
    library,
    load_plugin,
    plugins,
)
from fusion.analysis.effects.thermal import quasi_static
from fusion.common import NO_PLUGINS
from fusion.results.parts import PluginPart
from tests.fusion.small_campaign import campaign, logged


def everything() -> Readings:
    """A campaign in which every effect of the library can be tried."""
    rng = np.random.default_rng(3)
    jump = 0.1 * (-1.0) ** np.arange(60) + np.where(np.arange(60) > 20, -20.0, 0.0)
    positions = np.array([100.0, 200.0, 300.0, 400.0, 500.0])
    series = {
        "mean_rise": logged(jump, "K"),
        "axis_integral": Series(30.0 * np.arange(60), jump[:, None] * positions, "K mm"),
        "patch_mean_rise": logged(jump, "K"),
        "patch_axis_integral": Series(30.0 * np.arange(60), jump[:, None] * positions, "K mm"),
        "duty": logged(rng.uniform(size=60), "1"),
        "air_temperature": logged(20.0 + 0.01 * jump, "degC"),
        "air_pressure": logged(1013.0 + rng.uniform(size=60), "hPa"),
        "relative_humidity": logged(np.full(60, 50.0), "%"),
        "material_temperature": logged(20.0 + rng.uniform(size=60), "degC"),
        "temperature bed": logged(rng.uniform(size=60), "K"),
    }
    return campaign(cycles=14, positions_mm=tuple(positions), series=series, drivers=("duty",))


@pytest.mark.parametrize("effect", [*LIBRARY, quasi_static], ids=lambda effect: effect.name)
def test_every_effect_keeps_its_contract(effect):
    readings = everything()
    assert effect.label and effect.remedy and effect.physics and effect.source
    assert effect.words == effect.label != effect.name
    by_switching = {"thermal_lag": "field", "unseen_heat_source": "driver", "logged_influence": "driver"}
    assert effect.excited_by == by_switching.get(effect.name, "")
    assert effect.needs(readings) is None
    candidates = list(effect.candidates(readings, {"table_offset": 2.0, "axis_expansion": 10.0}, None))
    assert candidates
    for candidate in candidates:
        assert candidate.columns.shape == (readings.seconds.size, len(candidate.units))
        assert np.isfinite(candidate.columns).all()
        assert 0 <= candidate.beside < len(candidate.units)
        assert candidate.prior is None


def test_a_declarable_effect_has_one_candidate_without_a_model():
    declarable = {effect.name for effect in LIBRARY if effect.declarable}
    assert declarable == {"axis_expansion", "table_offset", "dead_path", "air_index", "material_compensation"}
    for name in declarable:
        (candidate,) = library()[name].candidates(everything(), {}, None)
        assert candidate.parameters == {} and candidate.columns.any()
    assert quasi_static.declarable


def test_every_effect_with_a_parameter_is_offered_again_near_each_of_its_candidates():
    """A closer look must hold candidates, or the search could not move."""
    readings = everything()
    for effect in LIBRARY:
        for candidate in list(effect.candidates(readings, {}, None))[::7]:
            near = list(effect.candidates(readings, {}, candidate))
            assert near, effect.name
            assert all(other.parameters.keys() >= candidate.parameters.keys() - _OPTIONAL for other in near), (
                effect.name
            )


#: Parameters that not every candidate of an effect has: those of what is followed.
_OPTIONAL = {"start", "second_time_constant_min"}


def test_a_users_effect_is_added_or_replaces_one_of_the_same_name(monkeypatch):
    def none(readings, coefficients, near):
        return iter(())

    own, other = Effect("own", "", "", none), Effect("dead_path", "", "", none)
    monkeypatch.setattr(library_module, "plugins", lambda: {"first": own, "second": other})
    monkeypatch.setattr(library_module, "load_plugin", lambda plugin, point: point)
    effects = library()
    assert list(effects)[-1] == "own" and effects["dead_path"] is other
    assert describe_effect("own") is own


def test_effects_are_described_by_name_the_declared_model_of_a_record_included():
    assert describe_effect("quasi_static") is quasi_static
    assert describe_effect("dead_path") is library()["dead_path"]
    assert describe_effect("sun_spots") is None


# Effects of other distributions: who brought them is known, what cannot be used is named, and they can be left out.


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
    monkeypatch.delenv(NO_PLUGINS, raising=False)
    yield tmp_path


def test_an_effect_of_another_distribution_is_listed_with_its_version_and_used(installed: Path) -> None:
    (added,) = plugins()
    assert added == PluginPart(
        name="bed_bending", origin="machine_effects:bed", distribution="machine-effects", version="1.4"
    )
    assert "bed_bending" in library()


def test_the_code_of_a_plug_in_is_found_without_importing_it(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "machine_effects", raising=False)
    (described,) = describe_code(library_module.GROUP)
    assert described["version"] == "1.4" and described["code"] == [installed / "machine_effects.py"]
    assert "machine_effects" not in sys.modules
    package = installed / "bed_effects"
    (package / "__pycache__").mkdir(parents=True)
    for name in ("__init__.py", "shapes.csv", "__pycache__/shapes.pyc"):
        (package / name).write_text("raise RuntimeError\n")
    points = [
        EntryPoint("bed", origin, library_module.GROUP) for origin in ("bed_effects.plates:bed", "absent_module:bed")
    ]
    monkeypatch.setattr(library_module, "entry_points", lambda group: points)
    of_package, of_none = describe_code(library_module.GROUP)
    assert of_package["code"] == [package / "__init__.py", package / "shapes.csv"]
    assert of_none["code"] == [] and of_none["distribution"] == "unknown"


def test_plugins_are_left_out_where_the_environment_says_so(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert plugins()
    monkeypatch.setenv(NO_PLUGINS, "1")
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
    plugin = PluginPart(name="bed_bending", origin=origin, distribution="machine-effects", version="1.4")
    with pytest.raises(PluginError) as error:
        load_plugin(plugin, EntryPoint("bed_bending", origin, library_module.GROUP))
    assert str(error.value) == (
        f"the effect bed_bending ({origin}) of machine-effects 1.4 {why}; "
        "correct or uninstall that distribution, or add --no-plugins"
    )
