"""What a folder holds is told in the words of the command, as text."""

from __future__ import annotations

from pathlib import Path

from fusion.app.setup.found import content_of, found_in_folder, name_in, warnings_of
from fusion.starting.inspection import Inspected
from fusion.starting.kinds import Kind


def test_every_file_of_a_campaign_has_a_row(campaign_folder: Path) -> None:
    shown = "".join(part.object for part in found_in_folder(campaign_folder))
    for expected in (
        "thermal/*.jpg",
        "24 frames of 640 x 480",
        "laser.csv",
        "24 cycles, 6 targets",
        "fiducials.csv",
        "12 discs",
    ):
        assert expected in shown


def test_a_wrong_file_is_named_with_its_reason_and_escaped(tmp_path: Path) -> None:
    (tmp_path / "<b>.csv").write_text("nonsense\n1\n")
    shown = "".join(part.object for part in found_in_folder(tmp_path))
    assert "&lt;b&gt;.csv is not used:" in shown and "<b>" not in shown


def test_a_campaign_file_below_is_led_to(copied: Path) -> None:
    shown = "".join(part.object for part in found_in_folder(copied.parent))
    assert f"{copied.name}/campaign.toml is the campaign file of a folder below" in shown
    assert "of a folder below" not in "".join(part.object for part in found_in_folder(copied))


def test_an_empty_folder_says_what_to_do(tmp_path: Path) -> None:
    (only,) = found_in_folder(tmp_path)
    assert "holds no file; put the files of the measurement into it" in only.object


def test_lines_are_told_apart_from_warnings() -> None:
    one = Inspected(
        "/a/b.csv", Kind.DRIVERS, ("/a/b.csv: drivers, 3 rows", "  duty 0 to 1", "  warning: a gap. Look at it.")
    )
    assert name_in(Path("/a"), one) == "b.csv"
    assert content_of(one) == "drivers, 3 rows; duty 0 to 1"
    assert warnings_of(one) == ["a gap. Look at it."]
