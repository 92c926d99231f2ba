"""What the documentation shows works: campaign files load, snippets run, commands exist, names are complete."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
from typer.main import get_command

from fusion import cli
from fusion.campaign.config import RECORD_EFFECTS, load_campaign
from fusion.diagnosis.causes import CAUSES
from fusion.effects.effect import Effect
from fusion.effects.library import LIBRARY
from fusion.effects.thermal import QUASI_STATIC
from fusion.products.results import CorrelationPart, Notice, SourcePart, assemble
from fusion.report.terminal import summary_rows
from tests.fusion.results_sample import PARTS

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def test_the_campaign_file_of_the_readme_loads(tmp_path: Path) -> None:
    campaign, record = blocks(README, "toml")
    (tmp_path / "thermal").mkdir()
    for name in ("thermal/a.jpg", "fiducials.csv", "laser.csv", "environment.csv", "drivers.csv", "spindle.xlsx"):
        (tmp_path / name).touch()
    (tmp_path / "campaign.toml").write_text(campaign, encoding="utf-8")
    assert load_campaign(tmp_path / "campaign.toml").model.declared == ("axis_expansion", "table_offset")
    (tmp_path / "record.toml").write_text('[campaign]\ntitle = "Spindle"\n' + record, encoding="utf-8")
    assert load_campaign(tmp_path / "record.toml").record is not None


def test_the_demo_of_the_readme_has_the_rows_that_a_run_prints() -> None:
    (shown,) = re.findall(r"^Demo: (.*?)^```", README, flags=re.DOTALL | re.MULTILINE)
    names = [name.strip() for name in re.findall(r"^│(.*?)│", shown, flags=re.MULTILINE) if name.strip()]
    source = SourcePart.model_construct(kind="cell", name="", part="common", x_mm=355.0, y_mm=95.0, p_value=0.002)
    correlation = CorrelationPart.model_construct(verdict="attributable", source=source, randomised_duty=None)
    inputs = {"state": "sound", "accepted": [], "checks": []}
    results = assemble("A", {**PARTS, "inputs": inputs}, [Notice("clock", "The clocks disagree.", "")] * 2)
    printed = [name for name, _ in summary_rows(results.model_copy(update={"correlation": correlation}))]
    # The sample states its window of cycles in other words.
    assert [name.partition(" (")[0] for name in names] == [name.partition(" (")[0] for name in printed]


def test_every_command_of_the_readme_exists() -> None:
    known = set(get_command(cli.app).commands)  # type: ignore[attr-defined]
    shown = {line.split()[1] for line in "\n".join(blocks(README, "sh")).splitlines() if line.startswith("thermofuse ")}
    assert shown == known


def test_the_effect_of_contributing_is_a_whole_effect() -> None:
    (snippet,) = blocks((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"), "python")
    names: dict[str, object] = {}
    exec(compile(snippet, "CONTRIBUTING.md", "exec"), names)
    effect = names["bed_bending"]
    assert isinstance(effect, Effect)

    class Readings:
        seconds = np.array([0.0, 600.0, 1200.0])
        share = np.array([0.0, 0.5, 1.0])

    candidates = list(effect.candidates(Readings(), {}, None))  # type: ignore[arg-type]
    assert [candidate.columns.shape for candidate in candidates] == [(3, 1)] * 3
    assert len(list(effect.candidates(Readings(), {}, candidates[1]))) == 11  # type: ignore[arg-type]


def test_the_layout_of_contributing_names_real_files() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for name in re.findall(r"`((?:fusion|data)/[\w./]+)`", text):
        assert (ROOT / name).exists(), name


def test_every_effect_of_the_library_has_its_words() -> None:
    assert all(effect.label and effect.remedy and effect.physics and effect.source for effect in LIBRARY)
    # What a record is declared with is no effect that a search could add.
    assert RECORD_EFFECTS == (QUASI_STATIC,)
    assert QUASI_STATIC not in {effect.name for effect in LIBRARY}


def test_every_cause_has_its_words_and_checks() -> None:
    from fusion.products.results import CAUSES as NAMES

    assert set(CAUSES) == set(NAMES)
    assert all(record.words and record.check for record in CAUSES.values())


def test_the_makefile_makes_what_the_readme_says() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^make (\w+)", README, flags=re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["scripts"]["thermofuse"] == "fusion.cli:main"
