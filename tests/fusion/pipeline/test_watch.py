"""A test that is watched: every cycle once, half-written ends wait, and what is shown agrees with the full run."""

import itertools
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pytest
import xarray as xr

from fusion.campaign.config import CampaignError, load_campaign
from fusion.pipeline.watch import (
    Arrived,
    ArrivingFrames,
    ArrivingReadings,
    CycleSeries,
    Enough,
    FieldsOfCycles,
    FinishedCycle,
    LiveState,
    follow,
    live_line,
)
from interferometry.deviations import build_deviations
from interferometry.drift.estimate import estimate_drift
from interferometry.drift.planning import plan_cycles
from interferometry.io.readings import read_deviations
from interferometry.iso230 import evaluate_iso230
from tests.fusion.campaign_parts import change, record_of_rows, without
from tests.fusion.laboratory import Laboratory, append, begin, copy_frames
from tests.thermography.flir_mutations import PARAMETERS
from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import Frame
from thermography.io.other_cameras import StackOptions, index_recordings
from thermography.registration.register import RegistrationError

pytestmark = pytest.mark.long


def watched(folder: Path, laboratory: Laboratory, **options: Any) -> list[LiveState]:
    return list(follow(load_campaign(folder / "campaign.toml"), stop=laboratory, clock=laboratory.clock, **options))


@pytest.fixture(scope="module")
def states(campaign_folder, tmp_path_factory):
    """Everything that a watch of the small campaign yields, whose frames and readings come in halves."""
    folder = begin(campaign_folder, tmp_path_factory.mktemp("watch") / "campaign")
    pieces = append(campaign_folder / "laser.csv", folder / "laser.csv", pieces=48)
    return watched(folder, Laboratory(copy_frames(campaign_folder, folder), pieces))


def test_every_cycle_is_finished_once_in_order_and_counts_never_fall(states):
    assert [state.cycle.number for state in states if state.cycle] == list(range(1, 25))
    assert (states[-1].frames, states[-1].readings, states[-1].cycles) == (24, 288, 24)
    assert not [warning for state in states for warning in state.warnings]
    for name in ("frames", "readings", "cycles"):
        assert np.all(np.diff([getattr(state, name) for state in states]) >= 0), name


def test_drift_is_that_of_the_readings(states, campaign_folder):
    deviation = read_deviations(campaign_folder / "laser.csv")["deviation"]
    drift = (deviation - deviation.isel(cycle=0)).mean("direction")
    shown = [state.cycle.drift_um for state in states if state.cycle]
    np.testing.assert_allclose(shown, drift.values, atol=1e-9)


def test_iso230_is_that_of_the_last_five_cycles(states, campaign_folder):
    deviations = read_deviations(campaign_folder / "laser.csv")
    for state in (state for state in states if state.iso230_um and state.cycles >= 5):
        last = state.cycle.number
        expected = evaluate_iso230(deviations, cycles=range(last - 4, last + 1))
        assert state.iso230_um["A"] == pytest.approx(float(expected["A"]))


def test_fields_are_those_of_the_full_run(states, results_folder):
    # The full run corrects the camera and registers all first frames together: a tenth of a kelvin, and no more, apart.
    with xr.open_dataset(results_folder / "fields.nc") as fields:
        for state in states:
            if state.cycle is not None and state.cycle.field is not None:
                full = fields["temperature"].sel(cycle=state.cycle.number)
                assert float(abs(full - state.cycle.field.values).mean()) < 0.1


def test_tells_whether_the_cycles_are_enough(states):
    early = [state.enough for state in states if state.enough and state.enough.cycles < 12]
    assert early and all("at least 12 cycles" in enough.lacks and not enough.is_enough for enough in early)
    last = states[-1].enough
    assert not last.lacks and 0.01 < last.u_um < 1.0


@pytest.mark.chain
def test_it_ends_when_nothing_has_come_for_so_long_and_a_wish_that_is_met_is_enough(campaign_folder):
    laboratory = Laboratory(idle=10_000)
    final = watched(campaign_folder, laboratory, until_idle_s=60.0, wanted_u_um=5.0)[-1]
    assert final.cycles == 24 and final.enough.is_enough
    assert 60.0 <= laboratory.seconds < 70.0


@pytest.mark.chain
def test_neither_a_camera_that_has_stopped_nor_a_clock_set_back_holds_anything_up(
    campaign_folder, tmp_path, monkeypatch
):
    folder = begin(campaign_folder, tmp_path / "campaign")
    hours = iter(np.linspace(0.0, -1e6, 1_000_000))
    monkeypatch.setattr(time, "time", lambda: 1.8e9 + next(hours))
    pieces = append(campaign_folder / "laser.csv", folder / "laser.csv", pieces=100)
    found = watched(folder, Laboratory(pieces))
    cycles = [state.cycle for state in found if state.cycle]
    assert [cycle.number for cycle in cycles] == list(range(1, 25))
    assert [cycle.frames for cycle in cycles] == [1] + 23 * [0]
    assert "cycle 2: no frame in this cycle" in [warning for state in found for warning in state.warnings]


@pytest.mark.chain
def test_windows_stand_for_cycles_without_a_laser(copied):
    campaign = without(copied / "campaign.toml", "interferometry", "plan.axis", "model", name="campaign.toml")
    change(campaign, 'table = "still"', 'table = "still"\nwindow = "6 min"')
    found = watched(copied, Laboratory(idle=1))
    assert [state.cycle.number for state in found if state.cycle] == list(range(1, 13))
    assert sum(state.cycle.frames for state in found if state.cycle) == 24
    assert found[-1].readings == 0 and not found[-1].iso230_um


def test_the_laser_alone_is_followed_and_a_line_that_cannot_be_used_told_once(copied):
    laser, campaign = copied / "laser.csv", copied / "campaign.toml"
    lines = laser.read_text().splitlines()
    lines[7] = lines[7].replace("positive", "sideways").replace("negative", "sideways")
    laser.write_text("\n".join(lines) + "\n")
    without(campaign, "thermography", "plan", "model", name=campaign.name)
    found = watched(copied, Laboratory(idle=2))
    assert found[-1].cycles == 24 and found[-1].frames == 0
    assert all(state.cycle.field is None for state in found if state.cycle)
    told = [warning for state in found for warning in state.warnings if "sideways" in warning]
    assert told == ["laser.csv, line 8: 'sideways' is neither 'positive' nor 'negative'"]


def test_a_record_cannot_be_followed(tmp_path):
    with pytest.raises(CampaignError, match="cannot be followed; run it when it is finished"):
        next(follow(load_campaign(record_of_rows(tmp_path, "0,20,0"))))


NAT = np.datetime64("NaT", "ns")


def line(**of_cycle: object) -> str:
    plain = {"frames": 0, "field": None, "field_range_degC": None, "rise_K": np.nan, "drift_um": np.zeros(0)}
    cycle = FinishedCycle(4, NAT, NAT, **{**plain, **of_cycle})
    return live_line(LiveState(3, 40, 4, cycle, {}, "", None, ()))


def test_a_cycle_is_told_in_a_line_and_judged_by_uncertainty_and_length():
    assert line() == "cycle 4: no usable data"
    assert line(frames=2) == "cycle 4: 2 frames, no field"
    assert line(drift_um=np.array([1.0, np.nan, -2.0])) == "cycle 4: drift -0.50 µm"
    told = line(frames=1, field_range_degC=(20.0, 21.5), rise_K=0.25)
    assert told == "cycle 4: 1 frame, 20.00 to 21.50 degC, rise 0.25 K"
    assert Enough(20, 0.05, 12, "").is_enough
    assert not Enough(11, 0.05, 12, "").is_enough
    assert not Enough(20, 0.05, 12, "Measure at least 12 cycles.").is_enough
    assert np.isnan(FinishedCycle(1, NAT, NAT, 0, None, None, np.nan, np.array([np.nan])).mean_drift_um)


def series_of(cycles, *, seed=1):
    """Three targets, a minute a cycle, readings that scatter by 0.5 um about a slow rise."""
    seconds = 10.0 * np.arange(6.0 * cycles).reshape(cycles, 2, 3)
    seconds[:, 1] = seconds[:, 1, ::-1]
    noise = np.random.default_rng(seed).normal(0.0, 0.5, seconds.shape)
    time = np.datetime64("2026-03-09T06:30") + (1e9 * seconds).astype("timedelta64[ns]")
    return build_deviations(
        range(1, cycles + 1), [1, 2, 3], np.array([0.0, 150.0, 300.0]), seconds / 3600 + noise, time
    )


def filled(deviations: xr.Dataset, wanted_u_um: float = 0.1) -> CycleSeries:
    series = CycleSeries(wanted_u_um)
    for cycle in range(deviations.sizes["cycle"]):
        series.add(deviations.isel(cycle=cycle))
        series.enough()
    return series


def test_drift_is_relative_to_the_first_reading_of_each_kind_at_the_targets_of_the_first_cycle():
    test = series_of(3)
    test["deviation"][:] = np.arange(18.0).reshape(3, 2, 3)
    test["deviation"][0, 0, 1] = np.nan
    series = CycleSeries(0.1)
    drifts = [series.add(test.isel(cycle=cycle)).tolist() for cycle in range(3)]
    # The second target has its first positive reading in the second cycle, from which it counts.
    assert drifts == [[0.0, 0.0, 0.0], [6.0, 3.0, 6.0], [12.0, 9.0, 12.0]]
    test = series_of(2)
    series = CycleSeries(0.1)
    series.add(test.isel(cycle=0).isel(target=[0, 2]))
    assert series.add(test.isel(cycle=1)).shape == (2,)


def test_iso230_needs_two_cycles_and_unjudged_readings_say_why():
    series = filled(series_of(1))
    assert series.iso230() == ({}, "")
    values, window = filled(series_of(7)).iso230()
    assert set(values) == {"B", "R", "E", "M", "A"} and window.startswith("cycles 3 to 7")
    test = series_of(4)
    test["deviation"][:] = np.nan
    enough = filled(test).enough()
    assert not enough.is_enough and np.isnan(enough.u_um)


def test_enough_is_what_the_planning_of_the_whole_test_says():
    test = series_of(40)
    enough = filled(test).enough()
    used = test.isel(cycle=slice(0, enough.cycles))
    plan = plan_cycles(used, estimate_drift(used), wanted_u_um=0.1)
    assert enough.cycles_for_wanted == plan.cycles
    assert enough.u_um == pytest.approx(plan.u_um * np.sqrt(plan.cycles / enough.cycles))
    assert not enough.lacks and enough.is_enough == (enough.cycles >= plan.cycles)


def test_a_long_test_is_judged_by_its_latest_cycles():
    """Time and memory stay bounded, and the uncertainty falls on with the root of the number of cycles."""
    test, series = series_of(260), CycleSeries(0.1)
    for cycle in range(260):
        series.add(test.isel(cycle=cycle))
    assert len(series._latest) == 200 and series.count == 260
    enough = series.enough()
    assert enough.cycles > 200
    assert enough.u_um == pytest.approx(0.5 * np.sqrt(2.0 / 2.0 / enough.cycles), rel=0.4)


HEADER = "cycle,direction,target,position_mm,time,deviation_um"


@pytest.fixture
def laser(tmp_path):
    return ArrivingReadings(tmp_path / "laser.csv", clock=lambda: 0.0)


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


def test_every_cycle_is_given_once_byte_by_byte(tmp_path):
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
    assert last.cycles["cycle"].values.tolist() == [5]
    assert sum(one.readings for one in [*arrived, last]) == 20
    assert not [fault for one in arrived for fault in one.faults]


def test_the_finished_cycles_hold_all_their_readings(laser):
    found = []
    for stop in range(2, 12):
        write(laser.path, lines(range(stop)))
        cycles = laser.poll().cycles
        if cycles is not None:
            found.append(cycles.isel(cycle=slice(0, -1)))
    whole = read_deviations(laser.path).isel(cycle=slice(0, -1))
    for name in ("deviation", "time"):
        xr.testing.assert_equal(xr.concat([cycles[name] for cycles in found], "cycle"), whole[name])


def test_only_new_lines_are_read(tmp_path, monkeypatch):
    import fusion.pipeline.watch as module

    path, sizes = tmp_path / "laser.csv", []
    read = module.read_long_table
    monkeypatch.setattr(module, "read_long_table", lambda table: sizes.append(len(table.rows)) or read(table))
    laser = ArrivingReadings(path)
    for stop in range(1, 60):
        write(path, lines(range(stop)))
        laser.poll()
    # Two cycles of context, the one that is finished, and the one that has just begun.
    assert max(sizes) <= 16


def test_cycles_numbered_from_zero_keep_their_numbers(laser):
    arrived = []
    for stop in range(1, 9):
        write(laser.path, lines(range(stop), first=0))
        arrived.append(laser.poll())
    assert given(arrived) == [1, 2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize(
    "header", ["# a comment\n\ncycle;direction;target;position_mm;time;deviation_um\n", f"\ufeff{HEADER}\r\n"]
)
def test_other_marks_and_lines_before_the_header(tmp_path, header):
    path = tmp_path / "laser.csv"
    path.write_text(header)
    laser = ArrivingReadings(path)
    assert laser.poll() == Arrived() or laser.poll().faults == ()
    mark = ";" if ";" in header else ","
    end = "\r\n" if "\r\n" in header else "\n"
    with path.open("a", newline="") as file:
        file.write(end.join(row.replace(",", mark) for row in lines(range(3))) + end)
    assert given([laser.poll()]) == [1, 2]


def test_a_table_by_run_is_read_as_a_whole_but_seldom(tmp_path):
    path, seconds, calls = tmp_path / "laser.csv", [0.0], []

    def read(file):
        calls.append(seconds[0])
        seconds[0] += 2.0
        return read_deviations(file)

    laser, arrived = ArrivingReadings(path, read, lambda: seconds[0]), []
    for runs in range(2, 12):
        write_runs(path, runs)
        seconds[0] += 10.0
        arrived.append(laser.poll())
    arrived.append(laser.poll(final=True))
    assert given(arrived[:-1])[:1] == [1]
    assert all(after - before >= 20.0 for before, after in itertools.pairwise(calls[:-1]))
    assert int(arrived[-1].cycles["cycle"][-1]) == 11


def test_a_file_that_is_not_there_yet_is_waited_for(laser):
    first, second = laser.poll(), laser.poll()
    assert "No such file" in first.faults[0] and second.faults == ()
    write(laser.path, lines(range(2)))
    assert given([laser.poll()]) == [1]


def test_a_line_of_a_growing_file_that_cannot_be_used_is_told_once(tmp_path):
    path = tmp_path / "laser.csv"
    rows = lines(range(4))
    rows[5] = rows[5].replace(",2,", ",two,")
    laser, faults = ArrivingReadings(path), []
    for stop in (8, 12, 16):
        write(path, rows[:stop])
        faults += laser.poll().faults
    assert len(faults) == 1 and faults[0].startswith("laser.csv, line 7:")


def test_a_file_that_is_begun_anew_is_told(laser):
    write(laser.path, lines(range(4)))
    laser.poll()
    shorter = f"{laser.path}: has become shorter; restart the watch if the test was restarted"
    write(laser.path, lines(range(1)))
    # At the first look it may just be being written.
    assert [laser.poll().faults for _ in range(3)] == [(), (shorter,), ()]
    for stop in (6, 8):
        write(laser.path, lines(range(stop)))
        arrived = laser.poll()
        assert arrived.faults == () and given([arrived]) == [stop - 2, stop - 1]
        write(laser.path, lines(range(2)))
        assert [laser.poll().faults for _ in range(2)] == [(), (shorter,)]


@pytest.mark.parametrize("cycles", [3, 4, 9], ids=["first shorter", "as long", "longer at once"])
def test_readings_of_a_test_begun_anew_are_not_mixed_with_those_before(laser, cycles):
    """Lines of the new test follow where the old one ended: without the check they would be shown as one test."""
    write(laser.path, lines(range(4)))
    assert laser.poll().cycles is not None
    write(laser.path, lines(range(cycles), zero=0.5))
    arrived = [laser.poll()]
    write(laser.path, lines(range(12), zero=0.5))
    arrived += [laser.poll(), laser.poll(final=True)]
    assert all(one.cycles is None for one in arrived)
    assert "was restarted" in "".join(fault for one in arrived for fault in one.faults)


def write_runs(path: Path, count: int, *, targets: int = 3, zero: float = 1.0) -> None:
    """A table by run, which is read as a whole."""
    head = ",".join(f"{run}+ [um],{run}- [um]" for run in range(1, count + 1))
    rows = [f"{100 * at}," + ",".join([f"{zero + at},{zero - at}"] * count) for at in range(targets)]
    path.write_text("\n".join([f"Position [mm],{head}", *rows]) + "\n")


@pytest.mark.parametrize("runs", [2, 9], ids=["shorter", "longer"])
def test_a_file_read_as_a_whole_that_is_begun_anew_is_told_by_its_first_cycle(laser, runs):
    """Cycle numbers alone would let cycles of a new test follow those of the old one."""
    write_runs(laser.path, 4)
    assert given([laser.poll()]) == [1, 2, 3]
    write_runs(laser.path, 5)
    assert given([laser.poll()]) == [4]
    write_runs(laser.path, runs, zero=2.0)
    arrived = laser.poll()
    assert arrived.cycles is None and "its first cycle has changed" in arrived.faults[0]


@pytest.mark.parametrize(("runs", "targets"), [(2, 3), (6, 2)], ids=["fewer cycles", "fewer targets"])
def test_a_file_caught_while_it_is_rewritten_is_waited_for(laser, runs, targets):
    write_runs(laser.path, 4)
    assert given([laser.poll()]) == [1, 2, 3]
    shorter = f"{laser.path}: has become shorter; restart the watch if the test was restarted"
    for whole in (6, 8):
        write_runs(laser.path, runs, targets=targets)
        caught = laser.poll()
        assert (caught.readings, caught.cycles, caught.faults) == (0, None, ())
        write_runs(laser.path, whole)
        arrived = laser.poll()
        assert arrived.faults == () and given([arrived]) == [whole - 2, whole - 1]
    for whole in (10, 12):
        write_runs(laser.path, runs, targets=targets)
        assert [laser.poll().faults for _ in range(3)] == [(), (shorter,), ()]
        write_runs(laser.path, whole)
        assert given([laser.poll()]) == [whole - 2, whole - 1]
    write_runs(laser.path, 3, zero=2.0)
    assert "restart the watch" in laser.poll().faults[0]


def test_a_file_that_is_short_when_the_test_is_over_is_told_at_once(laser):
    write_runs(laser.path, 4)
    laser.poll()
    write_runs(laser.path, 2)
    assert "has become shorter" in laser.poll(final=True).faults[0]


def test_a_spreadsheet_caught_while_it_is_written_is_waited_for(tmp_path):
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


def test_a_file_put_right_at_the_same_size_is_read_again(laser):
    write_runs(laser.path, 4)
    whole = laser.path.read_text()
    laser.path.write_text(whole.replace("Position", "Whatever"))
    os.utime(laser.path, ns=(0, 0))
    assert [len(laser.poll().faults) for _ in range(3)] == [0, 1, 0]
    laser.path.write_text(whole)
    assert given([laser.poll()]) == [1, 2, 3]


START = np.datetime64("2026-03-09T06:30:00", "ms")


def arriving(folder: Path, options: StackOptions | None = None) -> ArrivingFrames:
    return ArrivingFrames(lambda: sorted(folder.iterdir()), options or StackOptions())


def recording(folder: Path, frames: int, *, padding: int = 0) -> bytes:
    path = folder / "whole.seq"
    counts = np.random.default_rng(1).integers(17_000, 18_000, (frames, 12, 16)).astype(np.uint16)
    write_sequence(
        path,
        (Frame(counts=each, parameters=PARAMETERS, time=START + 33 * i) for i, each in enumerate(counts)),
        padding=padding,
    )
    content = path.read_bytes()
    path.unlink()
    return content


def grown(tmp_path: Path, content: bytes, step: int) -> list[str]:
    """Times of the frames of a sequence that grows by so many bytes, and rests at the end."""
    folder = tmp_path / "growing"
    folder.mkdir()
    camera, times = arriving(folder), []
    for start in range(0, len(content) + 3 * step, step):
        with (folder / "a.seq").open("ab") as file:
            file.write(content[start : start + step])
        frames, rejected = camera.poll()
        assert not rejected
        times += [str(frame.time) for frame in frames]
    return times


def test_a_growing_sequence_gives_every_frame_once(tmp_path):
    for number, (step, padding) in enumerate([(517, 0), (1500, 96), (4000, 0), (40_000, 96)]):
        folder = tmp_path / str(number)
        folder.mkdir()
        content = recording(folder, 12, padding=padding)
        (folder / "whole.seq").write_bytes(content)
        whole, _ = index_frames([folder / "whole.seq"])
        assert grown(folder, content, step) == [str(frame.time) for frame in whole]


def test_frames_of_a_growing_sequence_read_their_pixels(tmp_path):
    content = recording(tmp_path, 4)
    (tmp_path / "a.seq").write_bytes(content[: len(content) // 2])
    camera = arriving(tmp_path)
    first = camera.poll()[0] + camera.poll()[0]
    (tmp_path / "a.seq").write_bytes(content)
    rest = camera.poll()[0] + camera.poll()[0]
    expected = np.random.default_rng(1).integers(17_000, 18_000, (4, 12, 16)).astype(np.uint16)
    np.testing.assert_array_equal([frame.read_counts() for frame in [*first, *rest]], expected)
    assert [frame.index for frame in [*first, *rest]] == [0, 1, 2, 3]


def test_a_sequence_that_never_rests_is_read_while_it_grows(tmp_path):
    content = recording(tmp_path, 10)
    camera, step, counts = arriving(tmp_path), len(content) // 10, []
    for end in range(3, len(content) + 1, step):
        (tmp_path / "a.seq").write_bytes(content[:end])
        counts.append(len(camera.poll()[0]))
    # A frame is given when the next one has begun.
    assert sum(counts) == 8


def test_a_picture_that_is_being_copied_waits(tmp_path):
    write_jpeg(tmp_path / "IR_1.jpg", np.full((12, 16), 18_000, np.uint16), PARAMETERS, START)
    content = (tmp_path / "IR_1.jpg").read_bytes()
    camera = arriving(tmp_path)
    for end in (0, 10, len(content) // 2, len(content)):
        (tmp_path / "IR_1.jpg").write_bytes(content[:end])
        assert camera.poll() == ([], [])
    frames, rejected = camera.poll()
    assert (len(frames), rejected) == (1, [])
    assert camera.poll() == ([], [])


def test_what_cannot_be_used_is_told_once(tmp_path):
    (tmp_path / "IR_1.jpg").write_bytes(b"\xff\xd8 no thermogram")
    (tmp_path / "notes.txt").write_bytes(b"hello")
    camera = arriving(tmp_path)
    camera.poll()
    frames, rejected = camera.poll()
    assert not frames and {one.path.name for one in rejected} == {"IR_1.jpg", "notes.txt"}
    assert camera.poll() == ([], [])


def test_a_file_that_vanishes_is_named(tmp_path):
    camera = ArrivingFrames(lambda: [tmp_path / "gone.jpg"], StackOptions())
    _, rejected = camera.poll()
    assert "gone.jpg" in rejected[0].reason and camera.poll() == ([], [])


def test_the_mean_of_a_cycle_is_the_mean_of_its_frames(campaign_folder):
    campaign = load_campaign(campaign_folder / "campaign.toml")
    frames, _ = index_recordings(campaign.frame_paths())
    fields = FieldsOfCycles(campaign)
    fields.reduce(frames[:5])
    together, warnings = fields.reduce(frames[5:8])
    singly = [fields.reduce([frame])[0] for frame in frames[5:8]]
    assert warnings == ()
    np.testing.assert_allclose(together.values, np.mean(singly, axis=0), atol=2e-3)
    assert together.dims == ("y", "x") and together.attrs["units"] == "degC"
    assert fields.reduce([]) == (None, ("no frame in this cycle",))


def test_a_plan_that_is_not_seen_is_looked_for_again_ever_less_often(campaign_folder, monkeypatch):
    import fusion.pipeline.watch as module

    calls = []

    def refuse(*arguments, **options):
        calls.append(1)
        raise RegistrationError("too few discs")

    campaign = load_campaign(campaign_folder / "campaign.toml")
    frames, _ = index_recordings(campaign.frame_paths())
    monkeypatch.setattr(module, "register", refuse)
    fields = FieldsOfCycles(campaign)
    told = [fields.reduce(frames[:1]) for _ in range(20)]
    assert len(calls) == 5 and told[0] == (None, ("too few discs",)) and told[2] == (None, ())
    monkeypatch.undo()
    assert [fields.reduce(frames[:1])[0] is not None for _ in range(20)][-1]


def test_a_frame_that_cannot_be_read_costs_its_cycle_only(copied):
    campaign = load_campaign(copied / "campaign.toml")
    frames, _ = index_recordings(campaign.frame_paths())
    fields = FieldsOfCycles(campaign)
    assert fields.reduce(frames[:2])[0] is not None
    frames[2].path.unlink()
    field, warnings = fields.reduce(frames[2:3])
    assert field is None and frames[2].path.name in warnings[0]
    assert fields.reduce(frames[3:4])[0] is not None
