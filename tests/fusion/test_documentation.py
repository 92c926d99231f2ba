"""What the documentation shows works: campaign files load, snippets run, commands exist, names are complete."""

from __future__ import annotations

import os
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.main import get_command

import thermofuse
from fusion import cli
from fusion.analysis.diagnosis.causes import CAUSES
from fusion.analysis.effects.effect import Effect
from fusion.analysis.effects.library import LIBRARY
from fusion.analysis.effects.thermal import QUASI_STATIC
from fusion.campaign.config import RECORD_EFFECTS, load_campaign
from fusion.report.findings import brief_rows
from fusion.results.axis import CorrelationPart, SourcePart
from fusion.results.results import Notice, assemble
from fusion.twin.recipe_file import read_recipe
from tests.fusion.results_sample import PARTS
from tests.readme import blocks, try_page, typed_lines
from thermography.io.other_cameras import FrameReader, StackOptions
from thermography.registration.plan import read_fiducials

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
START = (ROOT / "docs/start/index.md").read_text(encoding="utf-8")
CAMPAIGN_FILE = (ROOT / "docs/reference/campaign-file.md").read_text(encoding="utf-8")
TUTORIALS = ROOT / "docs/tutorials"


def test_the_campaign_files_of_the_reference_load(tmp_path: Path) -> None:
    campaign, record = blocks(CAMPAIGN_FILE, "toml")
    (tmp_path / "thermal").mkdir()
    for name in ("thermal/a.jpg", "fiducials.csv", "laser.csv", "environment.csv", "drivers.csv", "spindle.xlsx"):
        (tmp_path / name).touch()
    (tmp_path / "campaign.toml").write_text(campaign, encoding="utf-8")
    assert load_campaign(tmp_path / "campaign.toml").model.declared == ("axis_expansion", "table_offset")
    (tmp_path / "record.toml").write_text('[campaign]\ntitle = "Spindle"\n' + record, encoding="utf-8")
    assert load_campaign(tmp_path / "record.toml").record is not None


def test_the_demo_of_the_start_page_has_the_rows_that_a_run_prints() -> None:
    (shown,) = re.findall(r"^Demo: .*?\n(.*?)^report:", START, flags=re.DOTALL | re.MULTILINE)
    names = [name.strip() for name in re.findall(r"^(\S.*?)  ", shown, flags=re.MULTILINE)]
    source = SourcePart.model_construct(kind="cell", name="", part="common", x_mm=355.0, y_mm=95.0, p_value=0.002)
    correlation = CorrelationPart.model_construct(verdict="attributable", source=source, randomised_duty=None)
    inputs = {"state": "sound", "accepted": [], "checks": []}
    results = assemble("A", {**PARTS, "inputs": inputs}, [Notice("clock", "The clocks disagree.", "")] * 2)
    printed = [name for name, _ in brief_rows(results.model_copy(update={"correlation": correlation}))]
    # The demo has a camera, which the sample of results has not.
    assert [name for name in names if name != "map"] == printed


def test_every_command_of_the_readme_exists() -> None:
    known = set(get_command(cli.app).commands)  # type: ignore[attr-defined]
    typed = {line.split()[1] for line in typed_lines(README) if line.startswith(".venv/bin/thermofuse ")}
    named = {words.split()[0] for words in re.findall(r"`([a-z0-9]+[^`\n/.]*)", README)}
    assert typed <= known and known <= typed | named


@pytest.mark.parametrize(
    ("cell", "ran", "fault"),
    [
        (":tags: [remove-input]\nassert Path('a').read_text() == 'b\\n'\nvalue", 3, ""),
        ("%%bash --no-raise-error\ntest $(cat a) = c", 3, ""),
        ("%%bash\ntest $(cat a) = c\ntrue", 2, "CalledProcessError"),
        ("absent", 2, "NameError"),
    ],
)
def test_a_cell_of_a_tutorial_that_fails_is_noticed(tmp_path: Path, cell: str, ran: int, fault: str) -> None:
    page = tmp_path / "page.md"
    cells = ("from pathlib import Path\nvalue = 1", "%%writefile a\nb", cell)
    page.write_text("".join(f"```{{code-cell}} ipython3\n{each}\n```\ntext\n" for each in cells))
    tried = try_page(page, sys.executable, {**os.environ, "PYTHONPATH": str(ROOT)})
    assert (tried.ran, fault in tried.fault, bool(tried.fault)) == (ran, True, bool(fault))


def test_the_readme_is_short_and_its_pictures_are_small() -> None:
    assert len(README.split()) <= 700
    for name in re.findall(r"!\[.*?\]\((.*?)\)", README):
        assert (ROOT / name).stat().st_size < 150_000, name


def test_the_secret_of_the_tutorial_is_that_of_the_demo() -> None:
    (secret,) = blocks((TUTORIALS / "demo.md").read_text(encoding="utf-8"), "toml")
    recipe = tomllib.loads((ROOT / "data/recipes/demo.toml").read_text(encoding="utf-8"))
    assert tomllib.loads(secret) == {table: recipe[table] for table in ("effect", "anomaly")}


def test_the_recipes_of_the_tutorials_are_valid(tmp_path: Path) -> None:
    page = (TUTORIALS / "position-3.md").read_text(encoding="utf-8")
    (recipe,) = re.findall(r"%%writefile loose.toml\n(.*?)```", page, flags=re.DOTALL)
    (tmp_path / "loose.toml").write_text(recipe, encoding="utf-8")
    assert read_recipe(tmp_path / "loose.toml").test.cycles == 60


def test_the_reader_of_the_how_to_reads_a_file(tmp_path: Path) -> None:
    reader, readings = blocks((ROOT / "docs/how-to/own-reader.md").read_text(encoding="utf-8"), "python")
    names: dict[str, Any] = {"__name__": "own_reader"}
    exec(compile(reader, "own-reader.md", "exec"), names)
    file = tmp_path / "20260309_063000.txt"
    file.write_text("THERM 3 2\n20.0 20.5 21.0\n22.0 22.5 23.0\n", encoding="ascii")
    therm = names["ThermReader"]()
    assert isinstance(therm, FrameReader) and therm.recognises(file, file.read_bytes())
    (frame,) = therm.index(file, StackOptions(time_in_name="%Y%m%d_%H%M%S"))
    assert frame.time == np.datetime64("2026-03-09T06:30:00")
    assert frame.read_temperature().tolist() == [[20.0, 20.5, 21.0], [22.0, 22.5, 23.0]]
    exec(compile(readings, "own-reader.md", "exec"), names)
    assert names["test"].sizes == {"cycle": 2, "direction": 2, "target": 3}


def test_the_points_of_the_how_to_are_fiducials(tmp_path: Path) -> None:
    (table,) = blocks((ROOT / "docs/how-to/no-markers.md").read_text(encoding="utf-8"), "text")
    (tmp_path / "fiducials.csv").write_text(table, encoding="utf-8")
    assert all(point.is_point for point in read_fiducials(tmp_path / "fiducials.csv"))


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
    for name in re.findall(r"`((?:thermography|interferometry|fusion|tests|docs|data)/[\w./-]+)`", text):
        assert (ROOT / name).exists(), name


def test_a_record_is_declared_with_no_effect_of_the_library() -> None:
    # What a record is declared with is no effect that a search could add.
    assert RECORD_EFFECTS == (QUASI_STATIC,)
    assert QUASI_STATIC not in {effect.name for effect in LIBRARY}


def test_every_cause_has_its_words_and_checks() -> None:
    from fusion.results.axis import CAUSES as NAMES

    assert set(CAUSES) == set(NAMES)
    assert all(record.words and record.check for record in CAUSES.values())


def test_python_on_the_pages_uses_public_names() -> None:
    pages = {"README.md": README, **{page.name: page.read_text(encoding="utf-8") for page in TUTORIALS.glob("*.md")}}
    for page, text in pages.items():
        assert set(re.findall(r"\btf\.(\w+)", text)) <= set(thermofuse.__all__), page
    (chain,) = blocks(README, "python")
    compile(chain, "README.md", "exec")


def test_every_dependency_has_its_reason() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    page = (ROOT / "docs/start/install.md").read_text(encoding="utf-8")
    listed = {
        name.strip() for cell in re.findall(r"^\| (.*?) \|", page, flags=re.MULTILINE) for name in cell.split(",")
    }
    needed = {re.split(r"[\[>]", one)[0] for one in project["dependencies"]}
    extras = {f"`{name}`" for name in project["optional-dependencies"]} - {"`docs`", "`test`"}
    assert needed | extras == listed - {"package", "extra", "---"}


def test_the_makefile_makes_what_the_readme_says() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^make (\w+)", README, flags=re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["scripts"]["thermofuse"] == "thermofuse.__main__:main"
