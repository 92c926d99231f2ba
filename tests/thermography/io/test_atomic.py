"""Files written whole or not at all."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from thermography.io.atomic import partial_path, write_atomically


def test_the_old_file_stays_until_the_new_one_is_whole_and_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "frames_00000001.sums"
    path.write_text("old")
    steps: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: steps.append(path.read_text()))

    def write(temporary: Path) -> None:
        assert temporary.suffix == path.suffix
        temporary.write_text("new")
        assert list(tmp_path.glob("frames_*.sums")) == [path]

    assert write_atomically(path, write) == path
    # The content is brought to the disk before the name, and the name after it.
    assert steps == (["old", "new"] if os.name == "posix" else ["old"])


def test_a_full_disk_leaves_the_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "fields.nc"
    path.write_text("old")

    def fill(temporary: Path) -> None:
        temporary.write_text("ne")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, fill)
    assert (path.read_text(), partial_path(path).exists()) == ("old", False)
