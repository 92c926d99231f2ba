"""TOML of others: a table, or one fault."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion.campaign.config import CampaignError, load_campaign
from fusion.starting.kinds import Kind, recognise
from fusion.toml_file import TomlError, read_toml
from fusion.twin.recipe_file import RecipeError, read_recipe


def test_the_tables_and_the_text(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(b"[campaign]\r\ntitle = 'X'\r\n")
    assert read_toml(path) == ({"campaign": {"title": "X"}}, "[campaign]\ntitle = 'X'\n")


def test_a_byte_order_mark_of_windows_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(b"\xef\xbb\xbf[campaign]\r\ntitle = 'X'\r\n")
    assert read_toml(path) == ({"campaign": {"title": "X"}}, "[campaign]\ntitle = 'X'\n")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("x = ", "Invalid value"),
        ("x = " + "[" * 100_000, "brackets stand in brackets too many times"),
        ("x = " + "{a=" * 20_000, "brackets stand in brackets too many times"),
        ("x = " + "[" * 40 + "]" * 40, "brackets stand in brackets too many times, more than 32 levels"),
        ("[" + ".".join(["a"] * 50_000) + "]", "line 1 has a key of more than 32 levels"),
        ("y = 1\n" + " . ".join(["'a'"] * 40) + " = 1", "line 2 has a key of more than 32 levels"),
        ("[x]\ny = [1, 0x" + "f" * 900_000 + "]", "x.y is a whole number beyond 64 bits; write a smaller one"),
        ("x = " + "9" * 6_000, "Exceeds the limit"),
        ("#" * 2_000_000, "longer than 1 MB"),
    ],
    ids=["no value", "lists", "tables", "levels", "header", "key", "hexadecimal", "digits", "length"],
)
def test_whatever_stands_in_it_is_one_fault_with_the_file(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(TomlError, match=reason):
        read_toml(path)
    with pytest.raises(CampaignError, match=rf"a\.toml: this is not TOML: .*{reason}"):
        load_campaign(path)
    with pytest.raises(RecipeError, match=rf"a\.toml: is not TOML \(.*{reason}"):
        read_recipe(path)
    found = recognise(path)
    assert found.kind is Kind.UNKNOWN and reason in found.reason


def test_very_many_faults_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("\n".join(f"a{number} = 1" for number in range(2_000)))
    with pytest.raises(CampaignError, match=r"a\.toml: and 1971 more faults$"):
        load_campaign(path)
    with pytest.raises(RecipeError, match=r"also 1970 more faults$"):
        read_recipe(path)


@pytest.mark.parametrize(
    ("pattern", "reason"),
    [
        ("*/" * 2_000 + "*", "has more than 64 folders"),
        ("*.jpg", r"IR_\\udcff\.jpg' has a name that is no text in UTF-8"),
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
