"""Values that carry their unit: the number arrives in the canonical unit, anything else is refused with an example."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from fusion.campaign import values as value_types
from fusion.campaign.values import (
    QuantityError,
    area,
    canonical_unit,
    column_conversion,
    conversion,
    has_unit,
    matching_files,
    name_and_unit,
    read_option,
    read_quantity,
    role_of_unit,
    stored_path,
    unit_name,
)


@pytest.mark.parametrize(
    ("text", "target", "value"),
    [
        ("1.2 m", "mm", 1200.0),
        ("1 in", "um", 25400.0),
        ("-5e1 \u00b5m", "mm", -0.05),
        ("68 \u00b0F", "degC", 20.0),
        ("293.15 kelvin", "degC", 20.0),
        ("1.5 hours", "s", 5400.0),
        ("11.7e-6 1/K", "ppm/K", 11.7),
        ("0.5 m/min", "mm/min", 500.0),
    ],
)
def test_numbers_arrive_in_the_canonical_unit(text: str, target: str, value: float) -> None:
    assert read_quantity(text, target) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (5, 'a length needs its unit in the value; write for example "5 mm"'),
        (True, 'a length needs its unit in the value; write for example "5 mm"'),
        ("five mm", 'this is not a length with a unit; write for example "5 mm"'),
        ("5 s", '"s" is not a unit of a length; use one of nm, um, mm, cm, m, in, mil, uin'),
        ("1e999 mm", 'the number is not finite; write for example "5 mm"'),
    ],
)
def test_anything_else_is_refused_with_an_example(value: object, message: str) -> None:
    with pytest.raises(QuantityError) as error:
        read_quantity(value, "mm")
    assert str(error.value) == message


def test_a_temperature_has_an_offset() -> None:
    assert conversion("K", "degC") == (1.0, -273.15)
    assert unit_name(" \u2103 ") == "degC" and unit_name("furlong") == "furlong"


def test_an_option_is_named_with_what_was_written() -> None:
    assert read_option("--spacing", "2 cm", "mm") == 20.0
    with pytest.raises(QuantityError, match=r'^--spacing "0": a length needs its unit in the value; write for example'):
        read_option("--spacing", "0", "mm")


# Tests of the types of values: what is written, the number in the unit of the name, and the sentence about what cannot be.


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
        ("PixelPatch", [0, 0, 1, 1], (0, 0, 1, 1)),
        ("MetresU", "5 cm", 0.05),
        ("Cycles", "10-14", (10, 14)),
        ("Point", ["120 px", "2 cm"], ((120.0, "px"), (20.0, "mm"))),
    ],
)
def test_a_value_comes_in_the_unit_of_its_name(name: str, written: Any, value: Any) -> None:
    read = TypeAdapter(getattr(value_types, name)).validate_python(written)
    assert read == (pytest.approx(value) if isinstance(value, float) else value)


@pytest.mark.parametrize(
    ("name", "beyond", "limits"),
    [
        ("Millimetres", "-1e5 mm", ["0 mm", "1e5 mm"]),
        ("PositiveMillimetres", "0 mm", ["1e5 mm"]),
        ("Celsius", "0 K", ["3000 degC"]),
        ("Seconds", "-3e9 s", ["-1 s", "3e9 s"]),
        ("PositiveSeconds", "0 s", ["1e6 s"]),
        ("PositiveMicrometres", "0 um", ["1e6 um"]),
        ("PartsPerMillion", "-10 ppm/K", ["-9 ppm/K", "200 ppm/K"]),
        ("Feed", "0 mm/min", ["1e6 mm/min"]),
        ("Fraction", "0.0001 %", ["0.001 %", "100 %"]),
        ("FractionU", "-1", ["0 %", "100 %"]),
        ("PartsPerMillionU", "0.001 ppm/K", ["200 ppm/K"]),
        ("KelvinU", "-1 K", ["0 K"]),
        ("ShareOfLengthU", "-1 ppm", ["0 ppm"]),
        ("MicrometresU", "-1 um", ["0 um"]),
        ("MetresU", "-1 mm", ["0 m"]),
    ],
)
def test_a_value_has_limits(name: str, beyond: str, limits: list[str]) -> None:
    read = TypeAdapter(getattr(value_types, name)).validate_python
    assert [isinstance(read(one), float) for one in limits] == [True] * len(limits)
    with pytest.raises(ValueError, match=r"must be above|outside 0 to 1|greater than or equal to 0"):
        read(beyond)


@pytest.mark.parametrize(
    ("name", "written", "why"),
    [
        ("Celsius", "3001 degC", "a temperature in degC must be above -273.15 and at most 3000"),
        ("FractionU", "101 %", "1.01 of a share lies outside 0 to 1"),
        ("Cycles", "5", "one cycle has no standard deviation"),
        ("Cycles", "5-1", 'ends before it begins; write for example "1-5"'),
        ("TimeUnit", "mm", "not a unit of a time; use one of"),
        ("PixelPatch", [0, 0, 0, 1], "contains no pixel"),
        ("PixelPatch", [0, -1, 1, 1], "contains no pixel"),
    ],
)
def test_a_value_that_cannot_be_is_refused(name: str, written: Any, why: str) -> None:
    with pytest.raises((ValueError, QuantityError), match=why):
        TypeAdapter(getattr(value_types, name)).validate_python(written)


@pytest.mark.parametrize(
    ("heading", "name", "unit"),
    [
        ("t1(°C)", "t1", "degC"),
        ("head (deg C)", "head", "degC"),
        ("Z [Microns]", "Z", "um"),
        ("spindle speed (RPM) ", "spindle speed", "RPM"),
        ("Z [um] left", "Z  left", "um"),
        ("elapsed_s", "elapsed", "s"),
        ("t/min", "t", "min"),
        ("T/K", "T", "K"),
        ("um/K", "um/K", ""),
        ("load/s", "load/s", ""),
        ("Z (100 mm)", "Z (100 mm)", ""),
        ("Z (12 s)", "Z", "12 s"),
        ("5x Z (mm)", "Z", "5x mm"),
        ("x10", "x10", ""),
    ],
)
def test_a_heading_has_a_name_and_a_unit(heading: str, name: str, unit: str) -> None:
    assert name_and_unit(heading) == (name, unit)


def test_a_column_is_counted_in_parts_of_its_unit_which_tells_what_it_holds() -> None:
    assert column_conversion("0.0125 mm", "um") == (12.5, 0.0)
    assert [role_of_unit(unit) for unit in ("0.1 °C", "mm", "A")] == ["temperature", "displacement", "driver"]
    assert has_unit("5 mm") and not has_unit("5 boxes")
    assert [canonical_unit(unit) for unit in ("um", "degF", "min")] == ["um", "degC", "s"]


def test_an_area_has_no_sense() -> None:
    corners = ((1.0, 0.0), (5.0, 0.0), (5.0, 3.0))
    assert area(corners) == area(corners[::-1]) == 6.0


@pytest.mark.parametrize("pattern", ["/**/*", "/**/*.jpg", "/*/**/*.jpg", "../" * 20 + "**/*.seq"])
def test_a_pattern_does_not_search_the_whole_disk(tmp_path: Path, pattern: str) -> None:
    with pytest.raises(ValueError, match=r"any depth \(\*\*\) below /, the root of a disk; name the folder"):
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


@pytest.mark.parametrize(
    ("lies", "written"),
    [
        ("IR [1]/a.jpg", "IR [1]/*.jpg"),
        ("run[1]?.csv", "run[1]?.csv"),
        ("Gro\u0308\u00dfe/e\u0301.csv", "Gr\u00f6\u00dfe/\u00e9.csv"),
        ("Gr\u00f6\u00dfe/\u00e9.csv", "Gro\u0308\u00dfe/e\u0301*"),
        ("a {0} #%41 'q' <b>/=1.csv", "a {0} #%41 'q' <b>/=?.csv"),
    ],
)
def test_a_file_is_found_by_its_name_whatever_it_is(tmp_path: Path, lies: str, written: str) -> None:
    (tmp_path / lies).parent.mkdir(exist_ok=True)
    (tmp_path / lies).touch()
    (tmp_path / "IR 1").mkdir()
    (tmp_path / "IR 1" / "a.jpg").touch()
    assert matching_files(tmp_path, written) == [tmp_path / lies]
    assert "*" in written or "?" in written or stored_path(tmp_path, written) == tmp_path / lies


def test_no_pattern_and_a_folder_match_no_file(tmp_path: Path) -> None:
    assert [matching_files(tmp_path, pattern) for pattern in ("", ".", "/", "..")] == [[], [], [], []]


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
    assert value_types.not_a_file(tmp_path) == f"{tmp_path} is a folder; name a file in it"
    assert value_types.not_a_file(tmp_path / "laser.csv").endswith("is a pipe, a socket or a device; name a file")
    (tmp_path / "file.csv").touch()
    assert not value_types.not_a_file(tmp_path / "file.csv") and not value_types.not_a_file(tmp_path / "absent.csv")
