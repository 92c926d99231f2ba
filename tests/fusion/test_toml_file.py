"""TOML files that a user writes: tables, or faults with line, key, value and remedy; never a traceback."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict, ValidationError

from fusion.campaign.config import CampaignError, load_campaign
from fusion.campaign.inspect import Kind, recognise
from fusion.common import suggest
from fusion.common.toml_files import TomlError, describe, find_line, key_lines, read_toml
from fusion.twin.recipe_file import RecipeError, read_recipe


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["", "byte order mark"])
def test_the_tables_and_the_text(tmp_path: Path, mark: bytes) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(mark + b"[campaign]\r\ntitle = 'X'\r\n")
    assert read_toml(path) == ({"campaign": {"title": "X"}}, "[campaign]\ntitle = 'X'\n")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("x = ", "Invalid value"),
        ("x = " + "[" * 100_000, "nested too deep"),
        ("x = " + "{a=" * 20_000, "nested too deep"),
        ("[" + ".".join(["a"] * 5_000) + "]", "nested too deep"),
        # Parsed, these take gigabytes.
        ("a." * 400_000 + "a = 1", "nested too deep"),
        ("x = {" + "'a' . " * 100_000 + "a = 1}", "nested too deep"),
        ("[x]\ny = [1, 0x" + "f" * 900_000 + "]", "a whole number beyond 64 bits"),
        ("x = " + "9" * 6_000, "Exceeds the limit"),
        ("#" * 2_000_000, "longer than 1 MB"),
    ],
    ids=["no value", "lists", "tables", "header", "key", "quoted key", "hexadecimal", "digits", "length"],
)
def test_whatever_stands_in_it_is_one_fault_with_the_file(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(TomlError, match=reason):
        read_toml(path)
    for read, error in ((load_campaign, CampaignError), (read_recipe, RecipeError)):
        with pytest.raises(error, match=rf"a\.toml: .*is not TOML.*{reason}"):
            read(path)
    found = recognise(path)
    assert found.kind is Kind.UNKNOWN and reason in found.reason


@pytest.mark.long
def test_very_many_faults_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("\n".join(f"a{number} = 1" for number in range(2_000)))
    with pytest.raises(CampaignError, match=r"a\.toml: and 1971 more faults$"):
        load_campaign(path)
    with pytest.raises(RecipeError, match=r"a\.toml: and 1970 more faults$"):
        read_recipe(path)


@pytest.mark.parametrize(
    ("pattern", "reason"),
    [
        ("*/" * 2_000 + "*", "has more than 64 folders"),
        ("*.jpg", r"IR_\\udcff\.jpg' has a name that is not valid UTF-8; rename it"),
        ("a" * 300 + "/*.jpg", "matches no file in"),
        ("a" * 300 + ".jpg", "matches no file in"),
        ("a\\u0000b/*.jpg", ""),
    ],
)
def test_patterns_without_end_and_names_that_are_no_text_are_refused(tmp_path: Path, pattern: str, reason: str) -> None:
    try:
        (tmp_path / "IR_\udcff.jpg").write_bytes(b"")
    except OSError:
        pytest.skip("this file system has no such names")
    path = tmp_path / "a.toml"
    path.write_text(f'[thermography]\nframes = ["{pattern}"]\n')
    with pytest.raises(CampaignError, match=rf"a\.toml, line 2: thermography\.frames = .*{reason}"):
        load_campaign(path)


@pytest.mark.parametrize("name", ["a\\u0000b.csv", "a" * 300 + ".csv", "a" * 5_000 + "/b.csv"])
def test_a_file_name_that_no_file_can_have_is_no_such_file(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(f'[interferometry]\ndeviations = "{name}"\n')
    with pytest.raises(CampaignError, match=r"a\.toml, line 2: interferometry\.deviations = .*: no such file "):
        load_campaign(path)


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "campaign.toml")
    with pytest.raises(TomlError, match="it is a pipe, a socket or a device; name a file"):
        read_toml(tmp_path / "campaign.toml")


def test_every_key_has_its_line() -> None:
    lines = key_lines('[plan]            # the table\nsize = [1, 2]\n"cell size" = 5\n\n[plan.axis]\norigin.x = 3\n')
    assert lines["plan",] == 1 and lines["plan", "size"] == 2 and lines["plan", "cell size"] == 3
    assert lines["plan", "axis", "origin"] == lines["plan", "axis", "origin", "x"] == 6
    # A key without a line of its own has that of the table that would hold it; nothing at all has line 1.
    assert find_line(lines, ("plan", "axis", "direction")) == 5
    assert find_line(lines, ("camera",)) == 1


def test_tables_of_an_array_have_lines_of_their_own() -> None:
    lines = key_lines('[[region]]\nname = "a"\n[[region]]\nname = "b"\n[region.part]\nlength = 3\n')
    assert lines["region",] == lines["region", "0"] == 1 and lines["region", "1"] == 3
    assert lines["region", "0", "name"] == 2 and lines["region", "1", "name"] == 4
    assert lines["region", "1", "part", "length"] == 6


def test_the_nearest_name_is_suggested() -> None:
    assert suggest("emisivity", ["frames", "emissivity"]) == "did you mean emissivity? "
    assert suggest("colour", ["frames", "emissivity"]) == ""


def test_a_fault_names_place_key_and_value() -> None:
    class Table(BaseModel):
        model_config = ConfigDict(extra="forbid")
        cycles: int = 1

    with pytest.raises(ValidationError) as caught:
        Table.model_validate({"cycles": [True, 2], "circles": 3})
    sentences = [describe(item, Table, lambda key: f"file, line {len(key)}") for item in caught.value.errors()]
    assert sentences[0].startswith("file, line 1: cycles = [true, 2]: ")
    assert sentences[1] == "file, line 1: unknown key circles; did you mean cycles? known here: cycles"
