"""Public measured files: listed completely, found locally, refused when they are not what they claim."""

from __future__ import annotations

import hashlib
from pathlib import Path
from urllib.parse import urlparse

import pytest

from fusion.campaign.remote import FOLDER_VARIABLE, DatasetError, fetch_sample, read_registry

NAME = "owner__project/folder/file.bin"


@pytest.fixture
def registry(tmp_path: Path) -> Path:
    digest = hashlib.sha256(b"measured").hexdigest()
    path = tmp_path / "registry.csv"
    path.write_text(
        f"name,address,sha256,bytes,licence,what\n{NAME},http://127.0.0.1:9/file.bin,{digest},8,MIT,a file\n",
        encoding="utf-8",
    )
    return path


def test_every_listed_file_has_a_public_address_a_hash_and_a_licence() -> None:
    listed = read_registry()
    assert len(listed) == 55
    for dataset in listed.values():
        address = urlparse(dataset.address)
        assert (address.scheme, address.netloc) == ("https", "raw.githubusercontent.com")
        owner, project, commit, *_ = address.path.strip("/").split("/")
        assert dataset.name.startswith(f"{owner}__{project}/")
        assert len(commit) >= 12 and int(commit, 16) >= 0
        assert len(dataset.sha256) == 64 and dataset.size > 0 and dataset.licence and dataset.what


@pytest.mark.real_data
def test_local_files_have_the_promised_size_and_hash(real_file) -> None:
    for name, dataset in read_registry().items():
        path = real_file(name)
        assert fetch_sample(name) == path
        assert path.stat().st_size == dataset.size


@pytest.mark.parametrize(
    ("content", "refusal"),
    [
        (b"measured", None),
        (b"invented", r"file\.bin: SHA-256 is .* the registry promises .*; fetch the file again"),
        (None, "does not exist; THERMOFUSE_DATA must name a folder"),
    ],
)
def test_a_local_folder_wins_over_the_network_where_it_holds_the_promised_file(
    registry: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes | None, refusal: str | None
) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    path = tmp_path / NAME
    path.parent.mkdir(parents=True)
    if content is not None:
        path.write_bytes(content)
    if refusal is None:
        assert fetch_sample(NAME, registry=registry) == path
    else:
        with pytest.raises(DatasetError, match=refusal):
            fetch_sample(NAME, registry=registry)


def test_an_unlisted_name_and_a_missing_registry_are_refused(registry: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"'nothing' is not listed in .*; the first of 1 names is 'owner__project"):
        fetch_sample("nothing", registry=registry)
    with pytest.raises(DatasetError, match="no registry of measured files; install thermofuse again"):
        fetch_sample(NAME, registry=tmp_path / "absent.csv")


def test_an_unreachable_address_says_how_to_go_on(
    registry: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    monkeypatch.setattr("pooch.os_cache", lambda name: tmp_path / name)
    with pytest.raises(
        DatasetError, match=r"not be fetched from http://127\.0\.0\.1:9/file\.bin .*copy the file by hand"
    ):
        fetch_sample(NAME, registry=registry)
