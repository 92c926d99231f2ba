"""Two finished runs of one machine told together: in joint.json and in both reports."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from fusion.attribution.two_sessions import SessionComparisonError
from fusion.pipeline.joining.campaigns import join_campaigns
from fusion.products.store import DamagedProductError, file_sha256, read_dataset, read_tree, write_dataset, write_json


@pytest.fixture
def folders(results_folder: Path, tmp_path: Path) -> list[Path]:
    """The same results twice, the second one under another title."""
    pair = [Path(shutil.copytree(results_folder, tmp_path / name)) for name in ("monday", "tuesday")]
    path = pair[1] / "results.json"
    path.write_text(path.read_text().replace("Small campaign", "Second campaign"))
    as_if_run(pair[1], "results.json")
    return pair


def as_if_run(folder: Path, name: str) -> None:
    """Enter a product into the provenance as its run would have, had it written it so."""
    provenance = json.loads((folder / "provenance.json").read_text())
    provenance["products"][name] |= {"sha256": file_sha256(folder / name)}
    write_json(folder / "provenance.json", provenance)


def test_both_reports_tell_what_the_sessions_agree_on(folders: list[Path], tmp_path: Path) -> None:
    rows = join_campaigns(folders, tmp_path)
    document = json.loads((tmp_path / "joint.json").read_text())
    assert document["campaigns"] == ["Small campaign", "Second campaign"]
    assert len(document["sources"]) == 4
    assert len(rows) == len(document["agreement"]) + 2
    assert rows[0][0] == "together" and rows[-1] == ("report", str((tmp_path / "joint.html").resolve()))
    page = (tmp_path / "joint.html").read_text(encoding="utf-8")
    assert "A (Small campaign)" in page and "B (Second campaign)" in page and 'href="tuesday/report.html"' in page
    # A session agrees with itself on whatever it shows.
    assert all(one["agrees"] and one["shown_by"] == [0, 1] for one in document["agreement"])
    assert read_dataset(tmp_path / "joint.nc")["p_value"].dims == ("channel", "y", "x")
    first, second = ((folder / "report.html").read_text() for folder in folders)
    assert "Together with B (Second campaign)" in first
    assert "Together with A (Small campaign)" in second


def test_other_grids_are_refused(folders: list[Path], tmp_path: Path) -> None:
    fusion = read_tree(folders[1] / "fusion.nc")
    for group in fusion["correlation"].subtree:
        if "x" in group.to_dataset(inherit=False).coords:
            group.coords["x"] = group["x"] + 7.0
    write_dataset(folders[1] / "fusion.nc", fusion)
    as_if_run(folders[1], "fusion.nc")
    with pytest.raises(SessionComparisonError, match="the plan grids differ along x"):
        join_campaigns(folders, tmp_path)


@pytest.mark.parametrize("name", ["results.json", "fusion.nc"])
def test_products_that_no_run_wrote_are_refused(folders: list[Path], tmp_path: Path, name: str) -> None:
    with (folders[0] / name).open("ab") as file:
        file.write(b" ")
    with pytest.raises(DamagedProductError, match=f"{name}: is not the file that this run wrote"):
        join_campaigns(folders, tmp_path)
    assert not (tmp_path / "joint.json").exists()
