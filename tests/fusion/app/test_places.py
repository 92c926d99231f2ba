"""Nothing outside the chosen folder is reached, by whatever spelling."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion.app.places import PlaceError, folder_within, name_of_file, place_within


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "root" / "inner").mkdir(parents=True)
    (tmp_path / "outside").mkdir()
    (tmp_path / "rootless").mkdir()
    (tmp_path / "root" / "link").symlink_to(tmp_path / "outside")
    return tmp_path / "root"


@pytest.mark.parametrize("written", ["inner", "inner/../inner", "./inner", " inner "])
def test_a_folder_inside_is_found(root: Path, written: str) -> None:
    assert folder_within(root, written) == root.resolve() / "inner"
    assert folder_within(root, str(root / "inner")) == root.resolve() / "inner"


@pytest.mark.parametrize(
    "written", ["..", "../outside", "inner/../../outside", "link", "link/x", "/etc", "/", "../rootless", "~"]
)
def test_a_path_outside_is_refused_with_the_remedy(root: Path, written: str) -> None:
    with pytest.raises(PlaceError, match=r"lies outside .*root.*; start it for that folder: thermofuse app "):
        place_within(root, written)


def test_what_is_no_folder_is_refused(root: Path) -> None:
    (root / "file").write_text("")
    for written in ("file", "absent"):
        with pytest.raises(PlaceError, match="no such folder"):
            folder_within(root, written)
    with pytest.raises(PlaceError, match="no zero byte"):
        place_within(root, "a\0b")
    (root / "itself").symlink_to(root / "itself")
    for written, reason in (("x" * 5000, "File name too long"), ("itself/x", "Symlink loop|symbolic links")):
        with pytest.raises(PlaceError, match=f"{reason}.*; type another path") as error:
            folder_within(root, written)
        assert len(str(error.value)) < 600


@pytest.mark.parametrize("written", ["", ".", "..", ".bashrc", "a/b", "a\\b", "C:x", "a\nb", "/etc/passwd"])
def test_an_uploaded_name_is_a_name_and_nothing_else(written: str) -> None:
    with pytest.raises(PlaceError, match="is not taken as the name of a file"):
        name_of_file(written)


def test_common_names_are_taken() -> None:
    assert name_of_file("IR_0001 (größer).jpg") == "IR_0001 (größer).jpg"
