"""Two finished runs of one machine told together: in joint.json, on a page of their own, and in both reports."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import CampaignError
from fusion.pipeline import compare
from fusion.pipeline.compare import compare_campaigns, compare_runs, require_one_kind
from fusion.pipeline.run import run_campaign
from fusion.results.results import read_results
from fusion.results.store import (
    DamagedProductError,
    OutputError,
    file_sha256,
    read_dataset,
    read_tree,
    write_dataset,
    write_json,
)
from tests.fusion.campaign_parts import change, record_of_rows
from tests.fusion.compared_tests import readings_of, write_results


@pytest.fixture
def folders(results_folder, tmp_path):
    """The same results twice, the second one under another title."""
    pair = [Path(shutil.copytree(results_folder, tmp_path / name)) for name in ("monday", "tuesday")]
    change(pair[1] / "results.json", "Small campaign", "Second campaign")
    as_if_run(pair[1], "results.json")
    return pair


def as_if_run(folder: Path, name: str) -> None:
    """Enter a product into the provenance as its run would have, had it written it so."""
    provenance = json.loads((folder / "provenance.json").read_text())
    provenance["products"][name] |= {"sha256": file_sha256(folder / name)}
    write_json(folder / "provenance.json", provenance)


def test_both_reports_tell_what_the_sessions_agree_on(folders, tmp_path):
    rows = compare_runs(folders, tmp_path)
    document = json.loads((tmp_path / "joint.json").read_text())
    assert document["campaigns"] == ["Small campaign", "Second campaign"]
    assert len(document["sources"]) == 4
    assert len(rows) == len(document["agreement"]) + 3
    assert rows[0][0] == "together" and rows[-2][0] == "changes"
    assert rows[-1] == ("report", str((tmp_path / "joint.html").resolve()))
    page = (tmp_path / "joint.html").read_text(encoding="utf-8")
    assert "as found (Small campaign" in page and "as left (Second campaign" in page
    assert 'href="tuesday/report.html"' in page
    # A session agrees with itself on whatever it shows.
    assert all(one["agrees"] and one["shown_by"] == [0, 1] for one in document["agreement"])
    assert read_dataset(tmp_path / "joint.nc")["p_value"].dims == ("channel", "y", "x")
    first, second = ((folder / "report.html").read_text() for folder in folders)
    assert "Together with the test as left (Second campaign" in first
    assert "Together with the test as found (Small campaign" in second


def test_other_grids_are_not_compared(folders):
    fusion = read_tree(folders[1] / "fusion.nc")
    for group in fusion["correlation"].subtree:
        if "x" in group.to_dataset(inherit=False).coords:
            group.coords["x"] = group["x"] + 7.0
    write_dataset(folders[1] / "fusion.nc", fusion)
    as_if_run(folders[1], "fusion.nc")
    (pair,) = compare_campaigns(folders)
    assert pair.places is None
    (places,) = [lack for lack in pair.not_compared if lack.code == "places"]
    assert places.named[0].startswith("the plan grids differ along x")


def test_two_tests_without_a_camera_are_compared_without_places(tmp_path):
    folders = [write_results(tmp_path / f"{seed}", readings_of(seed)) for seed in (31, 32)]
    rows = compare_runs(folders, tmp_path)
    assert [name for name, _ in rows] == ["changes", "report"]
    assert json.loads((tmp_path / "joint.json").read_text())["agreement"] == []
    assert "As found, as left" in (tmp_path / "joint.html").read_text() and not (tmp_path / "joint.nc").exists()


def test_a_page_that_no_run_wrote_is_not_replaced(folders, tmp_path):
    (tmp_path / "joint.html").write_text("mine")
    with pytest.raises(
        OutputError, match=r"joint\.html was not written by thermofuse and is not replaced; move it away"
    ):
        compare_runs(folders, tmp_path)
    assert (tmp_path / "joint.html").read_text() == "mine" and not (tmp_path / "joint.json").exists()


@pytest.mark.parametrize("name", ["results.json", "fusion.nc"])
def test_products_that_no_run_wrote_are_refused(folders, tmp_path, name):
    with (folders[0] / name).open("ab") as file:
        file.write(b" ")
    with pytest.raises(DamagedProductError, match=f"{name}: is not the file that this run wrote"):
        compare_runs(folders, tmp_path)
    assert not (tmp_path / "joint.json").exists()


def write_record(folder: Path, title: str, *, seed: int = 5, per_kelvin: float = 2.0, level: float = 0.0) -> Path:
    """A channel that follows one sensor, an hour long."""
    rng = np.random.default_rng(seed)
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.3, 60))
    moved = level + per_kelvin * (temperature - 20.0) + rng.normal(0.0, 0.05, 60)
    rows = [f"{60 * k},{t:.3f},{um:.3f}" for k, (t, um) in enumerate(zip(temperature, moved, strict=True))]
    return record_of_rows(folder, *rows, name=title)


@pytest.mark.chain
def test_of_two_records_response_and_level_are_compared(tmp_path):
    paths = [
        write_record(tmp_path, "Monday"),
        write_record(tmp_path, "Tuesday", seed=6),
        write_record(tmp_path, "Friday", seed=7, per_kelvin=3.0, level=40.0),
    ]
    require_one_kind(paths)
    folders = [tmp_path / "results" / path.stem for path in paths]
    for path, folder in zip(paths, folders, strict=True):
        run_campaign(path, folder)
    alike, other = ({one.group: one for one in pair.changes} for pair in compare_campaigns(folders))
    assert alike.keys() == other.keys() == {"response", "level", "noise"}
    assert not any(one.significant for one in alike.values())
    assert all(other[name].significant for name in ("response", "level"))
    assert other["response"].change.value == pytest.approx(50.0, abs=2.0 * other["response"].change.u)
    assert other["level"].change.value == pytest.approx(40.0, abs=2.0 * other["level"].change.u)
    # The noise has no uncertainty: it is shown and not judged. What would have been seen is more than the uncertainty.
    assert alike["noise"].shown_from is None and not other["noise"].significant
    assert alike["response"].shown_from > 2.0 * alike["response"].change.u
    # They are told together.
    rows = compare_runs(folders[:2], tmp_path)
    document = json.loads((tmp_path / "joint.json").read_text())
    assert document["campaigns"] == [name for name, _ in rows[:2]] == ["Monday", "Tuesday"]
    assert [one["rmse_final_um"] for one in document["records"]] == [
        read_results(folder).loop.rmse_final_um for folder in folders[:2]
    ]
    assert "held-out error" in rows[0][1] and rows[-1][0] == "changes"


def test_a_record_beside_both_instruments_is_refused(tmp_path, monkeypatch):
    class Loaded:
        def __init__(self, path):
            self.record = path.stem if path.stem == "record" else None

    monkeypatch.setattr(compare, "load_campaign", Loaded)
    with pytest.raises(CampaignError, match=r"record\.toml holds a \[record\], axis\.toml instruments"):
        require_one_kind([Path("axis.toml"), Path("record.toml")])
