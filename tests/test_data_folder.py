"""What the program knows lies in data/, is found from the clone, and its samples are what their recipes make."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import thermofuse as tf
from fusion.campaign.remote import REGISTRY
from fusion.twin.recipe_file import packaged_recipe
from thermofuse.resources import resource

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = ROOT / "data/samples"


def test_data_is_found_where_the_packages_lie() -> None:
    assert resource("samples") == SAMPLES
    assert REGISTRY == ROOT / "data/registry.csv" and packaged_recipe("demo") == ROOT / "data/recipes/demo.toml"


def test_an_installed_package_comes_before_the_clone(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("thermofuse.resources.__file__", str(tmp_path / "thermofuse/resources.py"))
    assert resource("registry.csv") == tmp_path / "data/registry.csv"
    (tmp_path / "thermofuse/data").mkdir(parents=True)
    assert resource("registry.csv") == tmp_path / "thermofuse/data/registry.csv"


def test_every_folder_of_data_is_described_and_samples_are_small() -> None:
    page = (ROOT / "data/README.md").read_text(encoding="utf-8")
    for path in (ROOT / "data").iterdir():
        assert path.name == "README.md" or f"`{path.name}{'/' if path.is_dir() else ''}`" in page, path.name
    assert sum(path.stat().st_size for path in SAMPLES.iterdir()) < 300_000


def test_the_samples_are_what_their_recipes_make(tmp_path: Path) -> None:
    tf.simulate_campaign(SAMPLES / "test.toml", tmp_path / "test")
    tf.simulate_campaign(SAMPLES / "record.toml", tmp_path / "record")
    for name in ("test/laser.csv", "record/record.csv"):
        assert (tmp_path / name).read_bytes() == (SAMPLES / Path(name).name).read_bytes()
    kept, made = (tf.read_frame(path) for path in (SAMPLES / "frame.jpg", tmp_path / "test/thermal/IR_0006.jpg"))
    # One count: the last digit of an interpolation may differ between processors.
    np.testing.assert_allclose(kept.counts.astype(int), made.counts.astype(int), atol=1)
    assert kept.parameters == made.parameters
