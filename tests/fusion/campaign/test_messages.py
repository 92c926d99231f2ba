"""Faults as sentences: the line of a key, the nearest name, the place in the file."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict, ValidationError

from fusion.campaign.messages import describe, find_line, key_lines, naming, suggest
from fusion.errors import FusionError
from interferometry.errors import InterferometryError
from thermography.errors import ThermographyError

TEXT = """\
[plan]            # the table
size = [1, 2]
"cell size" = 5

[plan.axis]
origin.x = 3
"""


def test_every_key_has_its_line() -> None:
    lines = key_lines(TEXT)
    assert lines[("plan",)] == 1 and lines[("plan", "size")] == 2 and lines[("plan", "cell size")] == 3
    assert lines[("plan", "axis", "origin")] == lines[("plan", "axis", "origin", "x")] == 6
    # A key without a line of its own has that of the table that would hold it; nothing at all has line 1.
    assert find_line(lines, ("plan", "axis", "direction")) == 5
    assert find_line(lines, ("camera",)) == 1


def test_tables_of_an_array_have_lines_of_their_own() -> None:
    lines = key_lines('[[region]]\nname = "a"\n[[region]]\nname = "b"\n[region.part]\nlength = 3\n')
    assert lines[("region",)] == lines[("region", "0")] == 1 and lines[("region", "1")] == 3
    assert lines[("region", "0", "name")] == 2 and lines[("region", "1", "name")] == 4
    assert lines[("region", "1", "part", "length")] == 6


def test_the_nearest_name_is_suggested() -> None:
    assert suggest("emisivity", ["frames", "emissivity"]) == "did you mean emissivity? "
    assert suggest("colour", ["frames", "emissivity"]) == ""


def test_a_fault_names_place_key_and_value() -> None:
    class Table(BaseModel):
        model_config = ConfigDict(extra="forbid")
        cycles: int = 1

    try:
        Table.model_validate({"cycles": [True, 2], "circles": 3})
    except ValidationError as error:
        sentences = [describe(item, Table, lambda key: f"file, line {len(key)}") for item in error.errors()]
    assert sentences[0].startswith("file, line 1: cycles = [true, 2]: ")
    assert sentences[1] == "file, line 1: unknown key circles; did you mean cycles? known here: cycles"


@pytest.mark.parametrize(
    ("told", "message"),
    [
        (InterferometryError("no reading has a time"), "c/laser.csv: no reading has a time"),
        (FusionError("the clocks disagree"), "c/campaign.toml: the clocks disagree"),
        (FusionError("c/campaign.toml, line 3: no"), "c/campaign.toml, line 3: no"),
        (ThermographyError("c/thermal/1.jpg: cut short"), "c/thermal/1.jpg: cut short"),
        (FusionError(), "c/campaign.toml: "),
        (FusionError("a speed in m/s"), "c/campaign.toml: a speed in m/s"),
    ],
)
def test_a_message_without_a_file_gets_one(told: ValueError, message: str) -> None:
    with pytest.raises(type(told)) as error, naming(Path("c/campaign.toml"), readings=Path("c/laser.csv")):
        raise told
    assert str(error.value) == message
