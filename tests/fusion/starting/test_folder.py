"""A folder: frames by pattern, other files by kind, results and hidden files left out."""

from __future__ import annotations

from pathlib import Path

from fusion.starting.folder import input_files, scan_folder
from fusion.starting.kinds import Kind


def test_a_campaign_folder_is_sorted_out(campaign_folder: Path) -> None:
    content = scan_folder(campaign_folder)
    assert content.frames == ("thermal/*.jpg",)
    assert len(content.frame_files) == len(list((campaign_folder / "thermal").iterdir()))
    assert {kind: [content.relative(one.path) for one in files] for kind, files in content.files.items()} == {
        Kind.CAMPAIGN: ["campaign.toml"],
        Kind.DRIVERS: ["drivers.csv"],
        Kind.ENVIRONMENT: ["environment.csv"],
        Kind.FIDUCIALS: ["fiducials.csv"],
        Kind.DEVIATIONS: ["laser.csv"],
    }
    assert content.unknown == () and content.of(Kind.LENS) == ()


def test_photos_results_and_hidden_files_are_no_input(copied: Path) -> None:
    (copied / "photos").mkdir()
    for name in "abcd":
        (copied / "photos" / f"{name}.jpg").write_bytes(b"\xff\xd8\xff\xe0" + b"\0" * 40 + b"\xff\xd9")
    (copied / "results").mkdir()
    (copied / "results" / "results.json").write_text("{}")
    (copied / "results" / "drift.csv").write_text("cycle,direction\n")
    (copied / ".hidden").write_text("x")
    content = scan_folder(copied)
    assert content.frames == ("thermal/*.jpg",)
    assert [content.relative(one.path) for one in content.unknown] == [f"photos/{name}.jpg" for name in "abcd"]


def test_links_to_folders_above_are_not_followed_for_ever(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x")
    for name in ("self", "again", "more"):
        (tmp_path / name).symlink_to(".")
    assert list(input_files(tmp_path)) == [tmp_path / "a.csv"]


def test_a_link_whose_file_is_gone_is_named_among_what_is_not_used(copied: Path) -> None:
    (copied / "spindle.jpg").symlink_to("moved.jpg")
    (copied / "ring.csv").symlink_to("ring.csv")
    assert [(one.path.name, one.reason) for one in scan_folder(copied).unknown] == [
        ("ring.csv", "a link to ring.csv, where there is no file"),
        ("spindle.jpg", "a link to moved.jpg, where there is no file"),
    ]
