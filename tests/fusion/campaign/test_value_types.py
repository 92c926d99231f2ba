"""Tests of the types of values: what is written, the number in the unit of the name, and the sentence about what cannot be."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError

from fusion.campaign import value_types


@pytest.mark.parametrize(
    ("name", "written", "value"),
    [
        ("Millimetres", "2 cm", 20.0),
        ("Metres", "1.2 m", 1.2),
        ("Celsius", "295.15 K", 22.0),
        ("PositiveSeconds", "5 min", 300.0),
        ("PartsPerMillion", "11.7 ppm/K", 11.7),
        ("Fraction", "45 %", 0.45),
        ("KelvinU", "20 mK", 0.02),
        ("TimeZone", "Europe/Vienna", "Europe/Vienna"),
        ("PixelPatch", [8, 8, 24, 16], (8, 8, 24, 16)),
    ],
)
def test_a_value_comes_in_the_unit_of_its_name(name: str, written: Any, value: Any) -> None:
    read = TypeAdapter(getattr(value_types, name)).validate_python(written)
    assert read == (pytest.approx(value) if isinstance(value, float) else value)


@pytest.mark.parametrize(
    ("name", "written", "fault"),
    [
        ("Seconds", 5, "a time needs its unit in the value"),
        ("PositiveMillimetres", "-1 mm", "this length in mm lies above 0"),
        ("Fraction", 1.5, "this fraction lies above 0 and up to 1"),
        ("FractionU", 2.0, "the standard uncertainty 2 of a share lies outside 0 to 1"),
        ("TimeZone", "Europe/Wien", "there is no such time zone; did you mean"),
        ("PixelPatch", [0, 0, 0, 5], "this patch holds no pixel of a frame"),
    ],
)
def test_a_value_that_cannot_be_is_named(name: str, written: Any, fault: str) -> None:
    with pytest.raises(ValidationError, match=fault):
        TypeAdapter(getattr(value_types, name)).validate_python(written)


@pytest.mark.parametrize("pattern", ["/**/*", "/**/*.jpg", "/*/**/*.jpg", "../" * 20 + "**/*.seq"])
def test_a_pattern_does_not_search_the_whole_disk(tmp_path: Path, pattern: str) -> None:
    with pytest.raises(
        PydanticCustomError,
        match=r"any depth \(\*\*\) below /, the root of a disk; name the folder of the files before the first",
    ):
        value_types.check_pattern(tmp_path, pattern)


def test_a_pattern_searches_a_million_files_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(value_types, "_MOST_SEARCHED", 4)
    (tmp_path / "day1" / "thermal").mkdir(parents=True)
    for number in range(2):
        (tmp_path / "day1" / "thermal" / f"{number}.jpg").touch()
    for pattern in ("**/*.jpg", "*/*/*.jpg", f"{tmp_path}/**/*.jpg", "day1/thermal/*.jpg"):
        value_types.check_pattern(tmp_path, pattern)
        assert len(value_types.matching_files(tmp_path, pattern)) == 2
    (tmp_path / "2.jpg").touch()
    value_types.check_pattern(tmp_path, "day1/thermal/*.jpg")
    with pytest.raises(PydanticCustomError, match=f"more than 4 files and folders in {tmp_path}; name the folder"):
        value_types.check_pattern(tmp_path, "**/*.jpg")


def test_only_what_a_pattern_looks_at_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    value_types.check_pattern(tmp_path, "/*/no-such-cam*/*.jpg")
    for name in ("day1/cam1/1.jpg", "day1/notes/deep/down/there", "day2/cam1/1.jpg", "day2/cam1/raw/2.jpg"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    # The folders day1 and day2, their cam1 and notes, and what lies in a cam1.
    monkeypatch.setattr(value_types, "_MOST_SEARCHED", 2 + 3 + 3)
    value_types.check_pattern(tmp_path, "*/cam*/*.jpg")
    monkeypatch.setattr(value_types, "_MOST_SEARCHED", 7)
    with pytest.raises(PydanticCustomError, match="more than 7 files"):
        value_types.check_pattern(tmp_path, "*/cam*/*.jpg")
    # Names without a wildcard are looked up, and the folders that hold them are not listed.
    value_types.check_pattern(tmp_path, "*/cam1/*.jpg")
    monkeypatch.setattr(value_types, "_MOST_SEARCHED", 1000)
    # A way back and links to the folder itself lead to the same files again and again.
    for day in ("day1", "day2"):
        (tmp_path / day / "again").symlink_to(tmp_path)
    for pattern in ("*/../" * 12 + "*.jpg", "*/" * 40 + "*.jpg"):
        with pytest.raises(PydanticCustomError, match="more than 1,000 files"):
            value_types.check_pattern(tmp_path, pattern)


def test_a_relative_pattern_names_files_where_they_are(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "1.jpg").touch()
    (tmp_path / "here").symlink_to(tmp_path / "disk")
    (tmp_path / "disk" / "2.jpg").symlink_to("1.jpg")
    (tmp_path / "disk" / "3.jpg").symlink_to("gone.jpg")
    real = tmp_path.resolve()
    assert sorted(value_types.matching_files(tmp_path, "here/*.jpg")) == [
        real / "disk" / "1.jpg",
        real / "disk" / "1.jpg",
        tmp_path / "here" / "3.jpg",
    ]


def test_pipes_and_sockets_that_a_pattern_matches_are_told_apart_from_files(tmp_path: Path) -> None:
    (tmp_path / "1.jpg").touch()
    (tmp_path / "2.jpg").symlink_to("gone.jpg")
    (tmp_path / "folder.jpg").mkdir()
    os.mkfifo(tmp_path / "3.jpg")
    (tmp_path / "4.jpg").symlink_to("/dev/null")
    assert sorted(value_types.matching_pipes(tmp_path, "*.jpg")) == [tmp_path / "3.jpg", tmp_path / "4.jpg"]
    assert sorted(value_types.matching_files(tmp_path, "*.jpg")) == [tmp_path / "1.jpg", tmp_path / "2.jpg"]
    assert value_types.matching_pipes(tmp_path, f"{'x' * 300}*") == []


def test_what_is_no_file_is_told(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "laser.csv")
    (tmp_path / "kernel.csv").symlink_to("/proc/kmsg")
    assert value_types.not_a_file(tmp_path) == f"{tmp_path} is a folder; name a file in it"
    assert value_types.not_a_file(tmp_path / "laser.csv").endswith("is a pipe, a socket or a device; name a file")
    assert "is a part of the system" in value_types.not_a_file(tmp_path / "kernel.csv")
    (tmp_path / "file.csv").touch()
    assert not value_types.not_a_file(tmp_path / "file.csv") and not value_types.not_a_file(tmp_path / "absent.csv")
