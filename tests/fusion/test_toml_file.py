"""TOML of others: a table, or one fault."""

from __future__ import annotations

import os
import time
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
        ("th*/*.jpg", r"th\\udcff/a\.jpg' has a name that is no text in UTF-8; rename it"),
        ("a" * 300 + "/*.jpg", "matches no file in"),
        ("a" * 300 + ".jpg", "matches no file in"),
        ("a\\u0000b.jpg", "matches no file in"),
        ("a\\u0000b/*.jpg", "matches no file in"),
    ],
)
def test_patterns_without_end_and_names_that_are_no_text_are_refused(tmp_path: Path, pattern: str, reason: str) -> None:
    try:
        (tmp_path / "IR_\udcff.jpg").write_bytes(b"")
        (tmp_path / "th\udcff").mkdir()
        (tmp_path / "th\udcff" / "a.jpg").write_bytes(b"")
    except OSError:
        pytest.skip("this file system has no such names")
    path = tmp_path / "a.toml"
    path.write_text(f'[thermography]\nframes = ["{pattern}"]\n')
    with pytest.raises(CampaignError, match=rf"a\.toml, line 2: thermography\.frames = .*{reason}"):
        load_campaign(path)


@pytest.mark.parametrize("name", ["a\\u0000b.csv", "a" * 300 + ".csv", "a" * 300 + "/b.csv"])
def test_a_file_name_that_no_file_can_have_is_no_such_file(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(f'[interferometry]\ndeviations = "{name}"\n')
    with pytest.raises(CampaignError, match=r"a\.toml, line 2: interferometry\.deviations = .*: no such file "):
        load_campaign(path)


DOTTED = ".".join(["a"] * 40)


@pytest.mark.parametrize(
    "text",
    [
        f"# {DOTTED}",
        f'x = "{DOTTED}"',
        f"x = '{DOTTED}'  # \"{DOTTED}",
        f'x = """\n{DOTTED} = 1\n"{DOTTED}"""""',
        f"x = '''\n{DOTTED} = 1 \"'''",
        f'x = ["\\"", "{DOTTED}"]',
    ],
    ids=["comment", "text", "text and comment", "lines", "lines as they are", "list"],
)
def test_dots_in_comments_and_text_are_no_levels(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(text)
    assert read_toml(path)[1] == text


@pytest.mark.parametrize(
    "before", ['x = 1 # "\n', 'x = "\\""\n', 'x = """a"""""\n', "x = '''a''''\n", "x = { y = '\"', "]
)
def test_keys_of_many_levels_behind_comments_and_text_are_found(tmp_path: Path, before: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(f"{before}{DOTTED} = 1" + (" }" if "{" in before else ""))
    with pytest.raises(TomlError, match=rf"line {1 + before.count(chr(10))} has a key of more than 32 levels"):
        read_toml(path)


@pytest.mark.parametrize("part", ['"\\', '"\\"', "'", '"""\\"', '"a".', "a.", "'''a"])
def test_text_without_its_end_is_told_in_time(tmp_path: Path, part: str) -> None:
    """The longest file of any such kind; the time would be minutes if it grew with the square of the length."""
    path = tmp_path / "a.toml"
    path.write_text("x = " + part * (900_000 // len(part)))
    begun = time.process_time()
    with pytest.raises(TomlError):
        read_toml(path)
    assert time.process_time() - begun < 10.0


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "campaign.toml")
    with pytest.raises(TomlError, match="it is a pipe, a socket or a device; name a file"):
        read_toml(tmp_path / "campaign.toml")


def test_a_part_of_the_system_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    (tmp_path / "campaign.toml").symlink_to("/proc/kmsg")
    for path in (tmp_path / "campaign.toml", Path("/proc/kmsg"), tmp_path / "../../../../../../proc/version"):
        with pytest.raises(TomlError, match="it is a part of the system and no file that was written"):
            read_toml(path)
