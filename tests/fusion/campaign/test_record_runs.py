"""Runs of a record: read in the order of their times, held to the same columns, and refused where they cannot be one test."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import CampaignError, load_campaign
from fusion.campaign.inputs import pipe_notices
from fusion.campaign.logged_tables import TableError
from fusion.campaign.record_runs import read_record

HEADING = "time,t1 [degC],ch1 [um],speed [rpm]"
CAMPAIGN = """\
[campaign]
title = "Runs"

[record]
{runs}
time = "{time}"
temperatures = ["t*"]
displacements = ["ch*"]
drivers = ["speed*"]
"""


def write_runs(folder: Path, runs: str, *, time: str = "time", **tables: str) -> Path:
    """A campaign file and the tables of its runs, by name."""
    for name, content in tables.items():
        (folder / f"{name}.csv").write_text(content, encoding="utf-8")
    (folder / "campaign.toml").write_text(CAMPAIGN.format(runs=runs, time=time), encoding="utf-8")
    return folder / "campaign.toml"


def stamped(day: int, *, heading: str = HEADING, hours: int = 3) -> str:
    """Rows from six o'clock on, one an hour."""
    rows = [f"2026-01-{day:02d}T{6 + hour:02d}:00:00Z,{20 + hour},{day},{hour}" for hour in range(hours)]
    return "\n".join([heading, *rows]) + "\n"


def elapsed(first: float = 0.0) -> str:
    """Three rows, one a minute."""
    return "\n".join([HEADING.replace("time", "time [s]"), *(f"{first + 60 * k},20,{k},{k}" for k in range(3))]) + "\n"


def test_runs_are_joined_in_the_order_of_their_times(tmp_path: Path) -> None:
    campaign = write_runs(tmp_path, 'files = "r*.csv"', r1=stamped(9), r2=stamped(7), r3=stamped(8))
    data = read_record(load_campaign(campaign))
    assert json.loads(data.attrs["runs"]) == ["r2.csv", "r3.csv", "r1.csv"]
    assert data["displacement"].values[:, 0].tolist() == [7.0] * 3 + [8.0] * 3 + [9.0] * 3
    assert data["run"].values.tolist() == [0] * 3 + [1] * 3 + [2] * 3
    assert json.loads(data.attrs["test"]) == [2]
    assert (np.diff(data["time"].values) > np.timedelta64(0)).all()


def test_a_pipe_among_the_runs_is_left_out_and_named(tmp_path: Path) -> None:
    campaign = load_campaign(write_runs(tmp_path, 'files = "r*.csv"', r1=stamped(9), r2=stamped(7)))
    assert pipe_notices(campaign) == []
    os.mkfifo(tmp_path / "r3.csv")
    assert json.loads(read_record(campaign).attrs["runs"]) == ["r2.csv", "r1.csv"]
    (notice,) = pipe_notices(campaign)
    assert notice.message == "record.files also matches 1 pipe, socket or device, which is left out: r3.csv."


def test_runs_that_count_from_their_own_zero_follow_the_order_of_the_files(tmp_path: Path) -> None:
    runs = 'files = ["b.csv", "a.csv"]\ntest = "b.csv"'
    campaign = write_runs(tmp_path, runs, time="time [s]", a=elapsed(), b=elapsed(1.0))
    data = read_record(load_campaign(campaign))
    assert json.loads(data.attrs["runs"]) == ["b.csv", "a.csv"]
    assert json.loads(data.attrs["test"]) == [0]
    assert (np.diff(data["time"].values) > np.timedelta64(0)).all()
    assert [str(path) for path in load_campaign(campaign).files_of("record")] == ["b.csv", "a.csv"]


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ('files = ["q*.csv"]', "matches no file"),
        ('file = "a.csv"\nfiles = ["a.csv", "b.csv"]', "write either file"),
        ("", "write either file"),
        ('file = "a.csv"\ntest = ["a.csv"]', "test names runs among files"),
        (
            'files = ["a.csv", "b.csv"]\ntest = ["c.csv"]',
            "test names c.csv, which files does not; the runs are a.csv, b.csv",
        ),
        ('files = ["a.csv", "b.csv"]\ntest = ["*.csv"]', "test names c.csv"),
        ('files = ["a.csv", "b.csv"]\ntest = ["a.csv", "b.csv"]', "test names all 2 runs"),
    ],
)
def test_runs_that_are_named_wrongly_are_refused(tmp_path: Path, runs: str, message: str) -> None:
    campaign = write_runs(tmp_path, runs, a=stamped(1), b=stamped(2), c=stamped(3))
    with pytest.raises(CampaignError, match=message):
        load_campaign(campaign)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (stamped(2, heading="time,t1 [degC],ch2 [um],speed [rpm]"), "ch1, ch2 is not in both"),
        (stamped(2, heading="time,t1 [degC],ch1 [um],speed [1/s]"), 'the driver "speed" is in 1/s, in a.csv in'),
        (stamped(1, hours=9), "begins at 2026-01-01T06:00:00, before .* has ended"),
    ],
)
def test_runs_that_cannot_be_one_record_are_refused(tmp_path: Path, other: str, message: str) -> None:
    campaign = write_runs(tmp_path, 'files = ["a.csv", "b.csv"]', a=stamped(1), b=other)
    with pytest.raises(TableError, match=message):
        read_record(load_campaign(campaign))
