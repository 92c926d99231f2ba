"""A stage is computed once for what it depends on, is kept after that, and is timed where it is computed."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import xarray as xr

from fusion.beside import Beside, InTurn
from fusion.campaign.config import load_campaign
from fusion.pipeline.provenance import hash_files
from fusion.pipeline.stages import Run, Stage
from fusion.products.progress import Report, silent
from fusion.products.results import Notice, Outcome
from fusion.products.store import StageStamps, read_dataset
from fusion.report.charts.campaign import Drawn


class Counting:
    """A stage's work that counts how often it is done."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self, *, report: Report) -> Outcome[xr.Dataset]:
        self.times += 1
        return Outcome(
            xr.Dataset({"drift": ("cycle", [0.5, 1.0])}), {"drift": 1.0}, (Notice("code", "said", "remedy"),)
        )


class Elsewhere(Beside):
    """Does the work at once, as a second process would before it is asked for."""

    def start(self, work: Callable[..., Any], report: Report | None = None) -> Callable[[], Any]:
        answer = work(**({} if report is None else {"report": report}))
        return lambda: answer

    def end(self) -> None:
        pass


def run_of(campaign_file: Path, folder: Path, beside: Beside | None = None) -> Run:
    campaign = load_campaign(campaign_file)
    inputs = hash_files(campaign.input_files(), report=silent)
    stamps = StageStamps(folder)
    return Run(campaign, folder, silent, stamps, inputs, {}, datetime.now(UTC), beside=beside or InTurn())


def deviations(work: Callable[..., Outcome[xr.Dataset]]) -> Stage[xr.Dataset]:
    return Stage("deviations", ("interferometry",), (), work, read_dataset)


def test_a_stage_is_kept_until_its_table_or_a_file_of_it_changes(copied: Path, tmp_path: Path) -> None:
    work, file = Counting(), copied / "campaign.toml"
    first = run_of(file, tmp_path / "results")
    first.stage(deviations(work))
    again = run_of(file, tmp_path / "results")
    xr.testing.assert_equal(again.stage(deviations(work))[["drift"]], first.stage(deviations(work))[["drift"]])
    assert work.times == 1
    assert again.parts == {"drift": 1.0} and again.notices == [Notice("code", "said", "remedy")]
    assert again.products == [tmp_path / "results" / "deviations.nc"]
    with (copied / "laser.csv").open("a") as readings:
        readings.write("\n")
    run_of(file, tmp_path / "results").stage(deviations(work))
    assert work.times == 2


def test_a_stage_is_computed_again_with_the_one_before_it(copied: Path, tmp_path: Path) -> None:
    work, later, file = Counting(), Counting(), copied / "campaign.toml"
    after = Stage("model", (), ("deviations",), later, read_dataset)
    for change in ("", "\n", ""):
        with (copied / "laser.csv").open("a") as readings:
            readings.write(change)
        run = run_of(file, tmp_path / "results")
        run.stage(deviations(work))
        run.stage(after)
    assert (work.times, later.times) == (2, 2)


def test_what_is_kept_is_not_begun_beside(copied: Path, tmp_path: Path) -> None:
    work, file = Counting(), copied / "campaign.toml"
    begun = run_of(file, tmp_path / "results", Elsewhere()).begin(deviations(work))
    assert work.times == 1
    begun()
    kept = run_of(file, tmp_path / "results", Elsewhere()).begin(deviations(work))
    assert kept()["drift"].values.tolist() == [0.5, 1.0] and work.times == 1


def test_what_a_stage_found_is_drawn_where_it_was_computed_or_from_what_is_kept(copied: Path, tmp_path: Path) -> None:
    work, file, seen = Counting(), copied / "campaign.toml", []

    def draw(outcome: Outcome[xr.Dataset]) -> Drawn:
        seen.append((outcome.parts, outcome.dataset["drift"].values.tolist()))
        return Drawn({})

    for _ in range(2):
        run = run_of(file, tmp_path / "results", Elsewhere())
        begun = run.begin(deviations(work), draw)
        (drawn,) = run.drawn
        assert drawn() == Drawn({})
        assert begun()["drift"].values.tolist() == [0.5, 1.0] and drawn() == Drawn({})
    assert work.times == 1, "computed once, then kept"
    assert seen == [({"drift": 1.0}, [0.5, 1.0])] * 2, "drawn once by each run"


def test_a_chart_that_cannot_be_drawn_costs_no_result(copied: Path, tmp_path: Path) -> None:
    work = Counting()

    def draw(outcome: Outcome[xr.Dataset]) -> Drawn:
        raise MemoryError("no room for a chart")

    run = run_of(copied / "campaign.toml", tmp_path / "results", Elsewhere())
    begun = run.begin(deviations(work), draw)
    assert begun()["drift"].values.tolist() == [0.5, 1.0]
    assert (tmp_path / "results" / "deviations.nc").is_file() and work.times == 1
    with pytest.raises(MemoryError, match="no room for a chart"):
        run.drawn[0]()
    again = run_of(copied / "campaign.toml", tmp_path / "results", Elsewhere())
    assert again.stage(deviations(work))["drift"].size == 2 and work.times == 1


def test_a_stage_begun_beside_counts_the_time_of_its_work_and_not_of_the_wait(copied: Path, tmp_path: Path) -> None:
    def slow(*, report: Report) -> Outcome[xr.Dataset]:
        time.sleep(0.3)
        return Counting()(report=report)

    run = run_of(copied / "campaign.toml", tmp_path / "results", Elsewhere())
    begun = run.begin(deviations(partial(slow)))
    time.sleep(0.6)
    begun()
    # Writing takes some hundredths of a second; the pause between beginning and asking is no part of the stage.
    assert 0.3 <= run.seconds["deviations"] < 0.6


def test_a_long_recording_keeps_the_cycles_of_its_own_input_alone(copied: Path, tmp_path: Path) -> None:
    run = run_of(copied / "campaign.toml", tmp_path / "results")
    old = tmp_path / "results" / ".stages" / "cycles_0123456789abcdef"
    old.mkdir(parents=True)
    stage = deviations(Counting())
    chosen = run.checkpoint(run.key_of(stage))
    assert chosen.parent == old.parent and chosen != old and not old.exists()
    assert run.checkpoint(run.key_of(stage)) == chosen


@pytest.mark.parametrize("changed", [True, False])
def test_the_key_of_a_stage_knows_its_tables_alone(copied: Path, tmp_path: Path, changed: bool) -> None:
    file = copied / "campaign.toml"
    stage = deviations(Counting())
    before = run_of(file, tmp_path / "results").key_of(stage)
    text = file.read_text()
    other = (
        re.sub("dead_path = .*", 'dead_path = "300 mm"', text)
        if changed
        else text.replace("title = ", "title = 'b' # ")
    )
    assert other != text
    file.write_text(other)
    assert (run_of(file, tmp_path / "results").key_of(stage) != before) is changed
