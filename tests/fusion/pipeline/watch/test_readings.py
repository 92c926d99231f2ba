"""Readings that arrive: each cycle once, whatever the kind of table; a line is read when it has its end."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import openpyxl
import pytest
import xarray as xr

from fusion.pipeline.watch.readings import Arrived, ArrivingReadings
from interferometry.io.readers import read_deviations

HEADER = "cycle,direction,target,position_mm,time,deviation_um"


def lines(cycles: range, *, first: int = 1, zero: float = 0.0) -> list[str]:
    """Two targets in both directions, a minute a cycle; cycles numbered from `first`."""
    rows = []
    for cycle in cycles:
        for at, (direction, target) in enumerate([("positive", 1), ("positive", 2), ("negative", 2), ("negative", 1)]):
            second = 60 * cycle + 10 * at
            time = f"2026-03-09T{6 + second // 3600:02d}:{second // 60 % 60:02d}:{second % 60:02d}Z"
            rows.append(f"{cycle + first},{direction},{target},{100 * (target - 1)},{time},{zero + cycle + at}")
    return rows


def write(path: Path, rows: list[str], header: str = f"{HEADER}\n") -> None:
    path.write_text(header + "\n".join(rows) + "\n")


def given(arrived: list[Arrived]) -> list[int]:
    """Numbers of the cycles that were finished: all but the open one of each look."""
    return [int(n) for one in arrived if one.cycles is not None for n in one.cycles["cycle"].values[:-1]]


def test_every_cycle_is_given_once_byte_by_byte(tmp_path: Path) -> None:
    content = (f"{HEADER}\n" + "\n".join(lines(range(5))) + "\n").encode()
    path = tmp_path / "laser.csv"
    path.write_bytes(b"")
    laser, arrived = ArrivingReadings(path), []
    for byte in range(0, len(content), 7):
        with path.open("ab") as file:
            file.write(content[byte : byte + 7])
        arrived.append(laser.poll())
    assert given(arrived) == [1, 2, 3, 4]
    last = laser.poll(final=True)
    assert last.cycles is not None and last.cycles["cycle"].values.tolist() == [5]
    assert sum(one.readings for one in [*arrived, last]) == 20
    assert not [fault for one in arrived for fault in one.faults]


def test_the_finished_cycles_hold_all_their_readings(tmp_path: Path) -> None:
    path = tmp_path / "laser.csv"
    laser = ArrivingReadings(path)
    found = []
    for stop in range(2, 12):
        write(path, lines(range(stop)))
        cycles = laser.poll().cycles
        if cycles is not None:
            found.append(cycles.isel(cycle=slice(0, -1)))
    whole = read_deviations(path).isel(cycle=slice(0, -1))
    for name in ("deviation", "time"):
        xr.testing.assert_equal(xr.concat([cycles[name] for cycles in found], "cycle"), whole[name])


def test_only_new_lines_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import fusion.pipeline.watch.readings as module

    path, sizes = tmp_path / "laser.csv", []
    read = module.read_long_table
    monkeypatch.setattr(module, "read_long_table", lambda table: sizes.append(len(table.rows)) or read(table))
    laser = ArrivingReadings(path)
    for stop in range(1, 60):
        write(path, lines(range(stop)))
        laser.poll()
    # Two cycles of context, the one that is finished, and the one that has just begun.
    assert max(sizes) <= 16


def test_cycles_numbered_from_zero_keep_their_numbers(tmp_path: Path) -> None:
    path = tmp_path / "laser.csv"
    laser, arrived = ArrivingReadings(path), []
    for stop in range(1, 9):
        write(path, lines(range(stop), first=0))
        arrived.append(laser.poll())
    assert given(arrived) == [1, 2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize(
    "header", ["# a comment\n\ncycle;direction;target;position_mm;time;deviation_um\n", f"\ufeff{HEADER}\r\n"]
)
def test_other_marks_and_lines_before_the_header(tmp_path: Path, header: str) -> None:
    path = tmp_path / "laser.csv"
    path.write_text(header)
    laser = ArrivingReadings(path)
    assert laser.poll() == Arrived() or laser.poll().faults == ()
    mark = ";" if ";" in header else ","
    end = "\r\n" if "\r\n" in header else "\n"
    with path.open("a", newline="") as file:
        file.write(end.join(row.replace(",", mark) for row in lines(range(3))) + end)
    assert given([laser.poll()]) == [1, 2]


def test_a_table_by_run_is_read_as_a_whole_but_seldom(tmp_path: Path) -> None:
    path, seconds, calls = tmp_path / "laser.csv", [0.0], []

    def read(file: Path) -> xr.Dataset:
        calls.append(seconds[0])
        seconds[0] += 2.0
        return read_deviations(file)

    laser, arrived = ArrivingReadings(path, read, lambda: seconds[0]), []
    for runs in range(2, 12):
        head = ",".join(f"{run}+ [um],{run}- [um]" for run in range(1, runs + 1))
        rows = [f"{100 * target}," + ",".join(f"{run}.1,{run}.2" for run in range(1, runs + 1)) for target in range(3)]
        path.write_text("\n".join([f"Position [mm],{head}", *rows]) + "\n")
        seconds[0] += 10.0
        arrived.append(laser.poll())
    arrived.append(laser.poll(final=True))
    assert given(arrived[:-1])[:1] == [1]
    assert all(after - before >= 20.0 for before, after in itertools.pairwise(calls[:-1]))
    assert arrived[-1].cycles is not None and int(arrived[-1].cycles["cycle"][-1]) == 11


def test_a_file_that_is_not_there_yet_is_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "laser.csv"
    laser = ArrivingReadings(path)
    first, second = laser.poll(), laser.poll()
    assert "No such file" in first.faults[0] and second.faults == ()
    write(path, lines(range(2)))
    assert given([laser.poll()]) == [1]


def test_a_line_that_cannot_be_used_is_told_once(tmp_path: Path) -> None:
    path = tmp_path / "laser.csv"
    rows = lines(range(4))
    rows[5] = rows[5].replace(",2,", ",two,")
    laser, faults = ArrivingReadings(path), []
    for stop in (8, 12, 16):
        write(path, rows[:stop])
        faults += laser.poll().faults
    assert len(faults) == 1 and faults[0].startswith("laser.csv, line 7:")


def test_a_file_that_is_begun_anew_is_told(tmp_path: Path) -> None:
    path = tmp_path / "laser.csv"
    laser = ArrivingReadings(path)
    write(path, lines(range(4)))
    laser.poll()
    shorter = f"{path}: has become shorter; watch the test anew if it was begun anew"
    write(path, lines(range(1)))
    # At the first look it may just be being written.
    assert [laser.poll().faults for _ in range(3)] == [(), (shorter,), ()]
    for stop in (6, 8):
        write(path, lines(range(stop)))
        arrived = laser.poll()
        assert arrived.faults == () and given([arrived]) == [stop - 2, stop - 1]
        write(path, lines(range(2)))
        assert [laser.poll().faults for _ in range(2)] == [(), (shorter,)]


@pytest.mark.parametrize("cycles", [3, 4, 9], ids=["first shorter", "as long", "longer at once"])
def test_readings_of_a_test_begun_anew_are_not_mixed_with_those_before(tmp_path: Path, cycles: int) -> None:
    """Lines of the new test follow where the old one ended: without the check they would be shown as one test."""
    path = tmp_path / "laser.csv"
    laser = ArrivingReadings(path)
    write(path, lines(range(4)))
    assert laser.poll().cycles is not None
    write(path, lines(range(cycles), zero=0.5))
    arrived = [laser.poll()]
    write(path, lines(range(12), zero=0.5))
    arrived += [laser.poll(), laser.poll(final=True)]
    assert all(one.cycles is None for one in arrived)
    assert "was begun anew" in "".join(fault for one in arrived for fault in one.faults)


def write_runs(path: Path, count: int, *, targets: int = 3, zero: float = 1.0) -> None:
    """A table by run, which is read as a whole."""
    head = ",".join(f"{run}+ [um],{run}- [um]" for run in range(1, count + 1))
    rows = [f"{100 * at}," + ",".join([f"{zero + at},{zero - at}"] * count) for at in range(targets)]
    path.write_text("\n".join([f"Position [mm],{head}", *rows]) + "\n")


@pytest.mark.parametrize("runs", [2, 9], ids=["shorter", "longer"])
def test_a_file_read_as_a_whole_that_is_begun_anew_is_told_by_its_first_cycle(tmp_path: Path, runs: int) -> None:
    """Cycle numbers alone would let cycles of a new test follow those of the old one."""
    path = tmp_path / "laser.csv"
    laser = ArrivingReadings(path, clock=lambda: 0.0)
    write_runs(path, 4)
    assert given([laser.poll()]) == [1, 2, 3]
    write_runs(path, 5)
    assert given([laser.poll()]) == [4]
    write_runs(path, runs, zero=2.0)
    arrived = laser.poll()
    assert arrived.cycles is None
    assert arrived.faults == (f"{path}: its first cycle is another one, it was begun anew; watch the test anew",)


@pytest.mark.parametrize(("runs", "targets"), [(2, 3), (6, 2)], ids=["fewer cycles", "fewer targets"])
def test_a_file_caught_while_it_is_rewritten_is_waited_for(tmp_path: Path, runs: int, targets: int) -> None:
    path = tmp_path / "laser.csv"
    laser = ArrivingReadings(path, clock=lambda: 0.0)
    write_runs(path, 4)
    assert given([laser.poll()]) == [1, 2, 3]
    shorter = f"{path}: has become shorter; watch the test anew if it was begun anew"
    for whole in (6, 8):
        write_runs(path, runs, targets=targets)
        caught = laser.poll()
        assert (caught.readings, caught.cycles, caught.faults) == (0, None, ())
        write_runs(path, whole)
        arrived = laser.poll()
        assert arrived.faults == () and given([arrived]) == [whole - 2, whole - 1]
    for whole in (10, 12):
        write_runs(path, runs, targets=targets)
        assert [laser.poll().faults for _ in range(3)] == [(), (shorter,), ()]
        write_runs(path, whole)
        assert given([laser.poll()]) == [whole - 2, whole - 1]
    write_runs(path, 3, zero=2.0)
    assert "was begun anew; watch the test anew" in laser.poll().faults[0]


def test_a_file_that_is_short_when_the_test_is_over_is_told_at_once(tmp_path: Path) -> None:
    path = tmp_path / "laser.csv"
    laser = ArrivingReadings(path, clock=lambda: 0.0)
    write_runs(path, 4)
    laser.poll()
    write_runs(path, 2)
    assert "has become shorter" in laser.poll(final=True).faults[0]


def test_a_spreadsheet_caught_while_it_is_written_is_waited_for(tmp_path: Path) -> None:
    """The saving program writes it in pieces: half of an archive is no spreadsheet, and is none that is damaged either."""
    table = tmp_path / "laser.xlsx"
    book = openpyxl.Workbook()
    for row in [HEADER, *lines(range(3))]:
        book.active.append(row.split(","))
    book.save(table)
    whole, path = table.read_bytes(), tmp_path / "watched.xlsx"
    laser = ArrivingReadings(path, clock=lambda: 0.0)
    for end in (500, 2000, 3000):
        path.write_bytes(whole[:end])
        caught = laser.poll()
        assert (caught.readings, caught.cycles, caught.faults) == (0, None, ())
    path.write_bytes(whole)
    assert given([laser.poll()]) == [1, 2]
    path.write_bytes(whole[:3000])
    told = [laser.poll().faults for _ in range(4)]
    assert [len(faults) for faults in told] == [0, 1, 0, 0] and "watched.xlsx" in told[1][0]


def test_a_file_put_right_at_the_same_size_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "laser.csv"
    laser = ArrivingReadings(path, clock=lambda: 0.0)
    write_runs(path, 4)
    whole = path.read_text()
    path.write_text(whole.replace("Position", "Whatever"))
    os.utime(path, ns=(0, 0))
    assert [len(laser.poll().faults) for _ in range(3)] == [0, 1, 0]
    path.write_text(whole)
    assert given([laser.poll()]) == [1, 2, 3]
