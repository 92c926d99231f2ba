"""Two finished runs of one machine told together: in joint.json and in both reports."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from fusion.attribution.two_sessions import SessionComparisonError, SourceAgreement
from fusion.pipeline.two_campaigns import join_campaigns, source_row
from fusion.products.store import read_dataset, read_tree, write_dataset


@pytest.fixture
def folders(results_folder: Path, tmp_path: Path) -> list[Path]:
    """The same results twice, the second one under another title."""
    pair = [Path(shutil.copytree(results_folder, tmp_path / name)) for name in ("monday", "tuesday")]
    path = pair[1] / "results.json"
    path.write_text(path.read_text().replace("Small campaign", "Second campaign"))
    return pair


def test_both_reports_tell_what_the_sessions_agree_on(folders: list[Path], tmp_path: Path) -> None:
    rows = join_campaigns(folders, tmp_path)
    document = json.loads((tmp_path / "joint.json").read_text())
    assert document["campaigns"] == ["Small campaign", "Second campaign"]
    assert len(document["sources"]) == 4
    assert len(rows) == max(len(document["agreement"]), 1)
    # A session agrees with itself on whatever it shows.
    assert all(one["agrees"] and one["shown_by"] == [0, 1] for one in document["agreement"])
    assert read_dataset(tmp_path / "joint.nc")["p_value"].dims == ("channel", "y", "x")
    first, second = ((folder / "report.html").read_text() for folder in folders)
    assert "Together with Second campaign" in first
    assert "Together with Small campaign" in second


def test_other_grids_are_refused(folders: list[Path], tmp_path: Path) -> None:
    fusion = read_tree(folders[1] / "fusion.nc")
    for group in fusion["correlation"].subtree:
        if "x" in group.to_dataset(inherit=False).coords:
            group.coords["x"] = group["x"] + 7.0
    write_dataset(folders[1] / "fusion.nc", fusion)
    with pytest.raises(SessionComparisonError, match="the plan grids differ along x"):
        join_campaigns(folders, tmp_path)


def test_a_source_of_one_session_names_that_session() -> None:
    one = SourceAgreement("common", 120.0, 60.0, (1,), (0.4, 0.01), (0.2, 1.0), (0.5, 0.1), (0.0, 600.0), False, True)
    row = source_row(one, ["Monday", "Tuesday"])
    assert row[0] == "120, 60"
    assert row[2] == "p 0.4, 0.2 ± 1.0 µm/K, lag 0 s"
    assert row[-1] == "shown by Tuesday alone"
    cause = SourceAgreement("common", 120.0, 60.0, (0, 1), (0.01, 0.01), (1.0, 1.0), (0.1, 0.1), (0.0, 0.0), True, True)
    assert source_row(cause, ["Monday", "Tuesday"])[-1] == "a cause: both agree"
    alike = replace(cause, separate=False)
    assert source_row(alike, ["Monday", "Tuesday"])[-1] == "both agree, but it may only warm with the leading source"
