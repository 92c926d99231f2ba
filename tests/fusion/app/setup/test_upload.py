"""Files go into the folder of the measurement and nowhere else, and replace nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion.app.places import PlaceError
from fusion.app.setup import upload
from fusion.app.setup.upload import UploadError, store_upload


def test_bytes_and_text_are_written_as_they_came(tmp_path: Path) -> None:
    assert store_upload(tmp_path, tmp_path, "a.bin", b"\x00\xff").read_bytes() == b"\x00\xff"
    assert store_upload(tmp_path, tmp_path, "ö.csv", "1,2\r\nµ").read_bytes() == "1,2\r\nµ".encode()
    (tmp_path / "in").mkdir()
    assert store_upload(tmp_path, Path("in"), "a.bin", b"").parent == tmp_path.resolve() / "in"
    with pytest.raises(UploadError, match="exists already and is not replaced; give the file another name"):
        store_upload(tmp_path, tmp_path, "a.bin", b"")


def test_a_large_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(upload, "LARGEST_MB", 1)
    with pytest.raises(UploadError, match=r"a\.bin is larger than 1 MB; copy it into .* with the file manager"):
        store_upload(tmp_path, tmp_path, "a.bin", bytes(1_000_001))
    assert not list(tmp_path.iterdir())


def test_no_name_leads_out_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link").symlink_to(tmp_path / "secret")
    for name in ("../x", "/etc/x", "..", ".profile", "link"):
        with pytest.raises(PlaceError):
            store_upload(tmp_path / "in", tmp_path / "in", name, b"x")
    with pytest.raises(PlaceError):
        store_upload(tmp_path / "in", tmp_path, "x", b"x")
    assert [path.name for path in tmp_path.iterdir()] == ["in"]
