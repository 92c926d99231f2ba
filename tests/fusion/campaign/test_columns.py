"""Logged tables of many layouts: what is proposed for them gives the record that the same data with headings written by hand give."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import numpy as np
import openpyxl
import pandas as pd
import pytest
import xarray as xr

from fusion.campaign.columns import ColumnsError, _column, _is_mark, _place_times, _power_on, propose_table
from fusion.campaign.config import CampaignError, load_campaign
from fusion.campaign.draft import Asker, DraftError, write_campaign
from fusion.campaign.inputs import read_record
from fusion.campaign.logs import TableError
from fusion.pipeline.check import check_campaign
from fusion.pipeline.record import guess_notices
from fusion.results.progress import clock_notices
from interferometry.io.faults import LaserFormatError

#: Minutes, spindle, bearing [degC], nose [mm], speed [1/min]; two hours, a row every half minute.
MINUTES = np.arange(240) / 2
START = np.datetime64("2026-03-09T22:30:00")
SPINDLE = np.round(21 + 8 * (1 - np.exp(-MINUTES / 40)), 2)
BEARING = np.round(20 + 3 * (1 - np.exp(-MINUTES / 60)), 2)
NOSE = np.round(0.004 * (SPINDLE - 21), 4)
SPEED = np.where(MINUTES < 60, 3000, 1500)
STAMPS = START + (60 * MINUTES).astype("m8[s]")


def rows(pattern: str) -> str:
    """Lines of the test by a pattern with the fields m, time, t1, t2, z and n."""
    return "".join(
        pattern.format(m=m, k=k, time=time, t1=t1, t2=t2, z=z, n=n) + "\n"
        for k, (m, time, t1, t2, z, n) in enumerate(
            zip(MINUTES, STAMPS.astype(object), SPINDLE, BEARING, NOSE, SPEED, strict=True)
        )
    )


#: Campbell Scientific, LoggerNet manual, "TOA5": station, names, units, processing.
TOA5 = (
    '"TOA5","Mill","CR1000","12345","CR1000.Std.32.02","CPU:mill.CR1","1842","Table1"\n'
    '"TIMESTAMP","RECORD","BattV_Min","TC_Avg(1)","TC_Avg(2)","LVDT_Avg"\n'
    '"TS","RN","Volts","Deg C","Deg C","mm"\n"","","Min","Avg","Avg","Avg"\n'
    + rows('"{time:%Y-%m-%d %H:%M:%S}",{k},12.6,{t1},{t2},{z}')
)
#: National Instruments, "Specification for the LabVIEW Measurement File (.lvm)"; as the samples of ladisk/lvm_read are written.
LVM = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\nDecimal_Separator\t,\nMulti_Headings\tNo\n"
    "X_Columns\t{columns}\nTime_Pref\tAbsolute\nDate\t2026/03/09\nTime\t22:29:59,1970510124996275989\n***End_of_Header***\t\n\t\n"
    "Channels\t3\t\t\t\nSamples\t240\t240\t240\t\nDate\t2026/03/09\t2026/03/09\t2026/03/09\t\nTime\t22:30:00,0000\t22:30:00,0000\t22:30:00,0000\t\n"
    "Y_Unit_Label\t°C\t°C\tmm\t\nX_Dimension\tTime\tTime\tTime\t\nDelta_X\t30,000000\t30,000000\t30,000000\t\n***End_of_Header***\t\t\t\t\n"
    "X_Value\tSpindel\tLager\tTaster\tComment\n"
)
LVM_ROWS = rows("{m}\t{t1}\t{t2}\t{z}").replace(".", ",")
#: What EPICS' camonitor prints, as in the logs of anderssandstrom/ecmc_target_muts_logger: a line for every change.
CHANNELS = {"MILL:TEMP-1": "t1", "MILL:TEMP-2": "t2", "MILL:DISP-Z": "z"}
MONITOR = "".join(
    f"{name:<30} {line}"
    for lines in zip(*(rows(f"{{time:%Y-%m-%d %H:%M:%S.%f}} {{{key}}}  ").splitlines(True) for key in CHANNELS.values()), strict=True)
    for name, line in zip(CHANNELS, lines, strict=True)
)  # fmt: skip
MONITOR += f"MILL:TEMP-1                    {rows('{time:%Y-%m-%d %H:%M:%S.%f}').splitlines()[-1]} 0 UDF INVALID\n"
MONITOR += "MILL:AIR                       *** Not connected (PV not found)\n"
#: The same test as a table of changes with the unit, or the quality, of every line.
LONG = [("Part 1", "t1", "degC"), ("Part 2", "t2", "degC"), ("Nose", "z", "mm")]
EPOCH_S = STAMPS.astype("M8[s]").astype(int)
LAYOUTS: dict[str, str] = {
    "changes with units": "stamp,sensor,value,unit\n" + "".join(
        f"{line},{unit}\n" for name, key, unit in LONG for line in rows(f"{{time:%Y-%m-%d %H:%M:%S}},{name},{{{key}}}").splitlines()
    ),
    "changes by epoch": "ts;tag;value;quality\n" + "".join(
        f"{1000 * at};{name};{value};192\n"
        for name, values in (("Temp_1", SPINDLE), ("Temp_2", BEARING), ("Disp_Z", NOSE))
        for at, value in zip(EPOCH_S, values, strict=True)
    ),
    "a clock of 12 hours": "Time,Date,T1,T2,Z\n" + rows("{time:%I:%M:%S %p},{time:%m/%d/%Y},{t1},{t2},{z}"),
    "toa5": TOA5,
    "lvm": LVM.format(columns="One") + "".join(
        f"{60 * m:.6f}".replace(".", ",") + "\t" + line.partition("\t")[2]
        for m, line in zip(MINUTES, LVM_ROWS.splitlines(True), strict=True)
    ),
    "lvm without times": LVM.format(columns="No") + "".join("\t" + line.partition("\t")[2] for line in LVM_ROWS.splitlines(True)),
    "camonitor": MONITOR,
    # Klipper's logs of frame expansion, as in tanaes/whopping_Voron_mods; -180 is a sensor that is not there.
    "klipper": "# id=x\nsample,time,pos_z,frame_t,bed_t,chamber_t,bed_target\n"
    + rows("{k},{time:%Y/%m/%d-%H:%M:%S},{z},{t1},{t2},-180.0,105.0"),
    "minutes without a unit": "Time,TT_100,TT_101,Z\n" + rows("{m},{t1},{t2},{z}"),
    "no times": "T1\tT2\tdelta L\n" + rows("{t1}\t{t2}\t{z}"),
    "times of day": "Uhrzeit;Spindel [°C];Lager [°C];Z [mm]\n" + rows("{time:%H:%M:%S};{t1};{t2};{z}").replace(".", ","),
    "times of day of 12 hours": "time;Spindel [°C];Lager [°C];Z [mm]\n" + rows("{time:%I:%M:%S %p};{t1};{t2};{z}"),
    "row of units": "Logger 7\n\ntime,spindle,bearing,nose\ns,degC,K,mm\n"
    + "".join(f"{60 * m},{t1},{t2 + 273.15:.2f},{z}\n" for m, t1, t2, z in zip(MINUTES, SPINDLE, BEARING, NOSE, strict=True)),
    "date and time": "Date,Time,T1,T2,Z\n" + rows("{time:%Y-%m-%d},{time:%H:%M:%S},{t1},{t2},{z}"),
    "spaces, no headings": rows("{m}  {t1}  {t2}  {z}"),
}  # fmt: skip
DATED = {
    "changes with units", "changes by epoch", "a clock of 12 hours", "toa5", "lvm", "lvm without times", "camonitor", "klipper",
    "date and time",
}  # fmt: skip


def drafted(folder: Path, content: str | bytes, name: str, answers: dict[str, str] | None = None) -> xr.Dataset:
    """Read the record of a folder that somebody describes with Enter at every question but those in `answers`."""
    folder.mkdir()
    (folder / name).write_bytes(content.encode("cp1252") if isinstance(content, str) else content)

    left = dict(answers or {})

    def ask(question: str, default: str) -> str:
        return next((left.pop(start) for start in list(left) if question.startswith(start)), default)

    path, missing = write_campaign(folder, Asker(ask))
    assert missing == []
    return read_record(load_campaign(path))


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    """The test with headings that say everything."""
    text = "time,t1 [degC],t2 [degC],z [mm]\n" + rows("{time:%Y-%m-%dT%H:%M:%S},{t1},{t2},{z}")
    folder = tmp_path_factory.mktemp("by_hand")
    (folder / "log.csv").write_text(text)
    (folder / "campaign.toml").write_text(
        '[campaign]\ntitle = "A"\n[record]\nfile = "log.csv"\ntime = "time"\ntemperatures = ["t*"]\ndisplacements = ["z*"]\n'
    )
    return read_record(load_campaign(folder / "campaign.toml"))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_gives_the_record_of_headings_written_by_hand(
    tmp_path: Path, by_hand: xr.Dataset, layout: str
) -> None:
    answers = {"Unit of the times": "min", "Time from one row": "30 s"}
    if layout == "spaces, no headings":
        answers["Column of the displacement"] = "4 = displacement mm"
    data = drafted(tmp_path / "folder", LAYOUTS[layout], "log.txt", answers)
    np.testing.assert_allclose(data["temperature"].values, by_hand["temperature"].values, atol=1e-9)
    np.testing.assert_allclose(data["displacement"].values, by_hand["displacement"].values, atol=1e-9)
    times, expected = data["time"].values, by_hand["time"].values
    if layout not in DATED:
        times, expected = times - times[0], expected - expected[0]
    np.testing.assert_array_equal(times, expected)


def test_values_are_held_between_their_changes(tmp_path: Path, by_hand: xr.Dataset) -> None:
    """Lines of one channel each, a second apart, of what moved by 0.05 K or 0.5 um: the rows of the regular table within the dead bands."""
    lines, last = list[tuple[np.datetime64, str]](), dict[str, float]()
    delays = np.random.default_rng(1).uniform(0, 1e6, (MINUTES.size, 3)).astype("m8[us]")
    for k, stamp in enumerate(STAMPS):
        now = {"TEMP-1": (SPINDLE, 0.05), "TEMP-2": (BEARING, 0.05), "DISP-Z": (NOSE, 0.0005)}
        for (name, (values, dead)), delay in zip(now.items(), delays[k], strict=True):
            if abs(values[k] - last.get(name, np.inf)) >= dead:
                last[name] = values[k]
                at = str((stamp + delay).astype("M8[us]")).replace("T", " ")
                lines.append((stamp + delay, f"MILL:{name:<24} {at} {values[k]}\n"))
    text = [line for _, line in sorted(lines)]
    text.insert(60, "MILL:TEMP-2                  *** Disconnected\n")
    data = drafted(tmp_path / "folder", "".join(text), "mill.log")
    (held,) = json.loads(data.attrs["held"])
    assert held["lost"] == ["MILL:TEMP-2 (line 61)"] and json.loads(data.attrs["left_out"]) == []
    rows_of = np.rint((data["time"].values - STAMPS[0]) / np.timedelta64(30, "s")).astype(int)
    step = float(np.diff(rows_of).mean()) * 30.0
    assert 30.0 <= step <= 120.0 and rows_of[-1] >= MINUTES.size - 40
    # Between two rows and within its dead band a value may have moved on.
    drift = step / 60.0 * np.array([8 / 40, 3 / 60])
    errors = np.abs(data["temperature"].values - by_hand["temperature"].values[rows_of])
    assert np.all((errors <= 0.06 + drift) | np.isnan(errors)) and 0 < np.isnan(errors[:, 1]).sum() < 20
    assert np.all(np.abs(data["displacement"].values - by_hand["displacement"].values[rows_of]) <= 0.6 + 4 * drift[0])


def test_rows_of_one_logger_each_are_held_until_its_next(tmp_path: Path, by_hand: xr.Dataset) -> None:
    """Two loggers' rows one below the other, as pandas writes lines of JSON; a channel that ends early is not held."""
    lines = ["time,T1 [degC],T2 [degC],Z [mm]"]
    for k, stamp in enumerate(STAMPS):
        lines += [f"{stamp},,,{NOSE[k]}"] + [f"{stamp + 7},{SPINDLE[k]},{BEARING[k]},"] * (k % 4 == 0)
    data = drafted(tmp_path / "apart", "\n".join(lines), "apart.csv")
    assert data.sizes["time"] == MINUTES.size and json.loads(data.attrs["held"])[0]["fastest"] == "Z [mm]"
    assert np.nanmax(np.abs(data["displacement"].values - by_hand["displacement"].values)) < 1e-9
    # Until the next one, two minutes later, a temperature stays.
    errors = np.abs(data["temperature"].values - by_hand["temperature"].values)
    assert np.isnan(errors).any(axis=1).sum() <= 1 and np.nanmax(errors) < 2.2 * 8 / 40
    ended = [line for k, line in enumerate(lines) if k < len(lines) / 2 or ",,," in line]
    data = drafted(tmp_path / "ended", "\n".join(ended), "ended.csv")
    assert json.loads(data.attrs["held"]) == []


def test_a_state_in_place_of_a_value_ends_it(tmp_path: Path) -> None:
    """Home Assistant's history: a sensor that is unavailable from the middle on is not held to the end."""
    lines = ["entity_id,state,last_changed"]
    for k, stamp in enumerate(STAMPS):
        if k < 120:
            lines.append(f"sensor.spindle_temperature,{SPINDLE[k] if k != 119 else 'unavailable'},{stamp}Z")
        lines += [f"sensor.bearing_temperature,{BEARING[k]},{stamp}Z", f"sensor.nose_um,{1000 * NOSE[k]:.1f},{stamp}Z"]
    data = drafted(tmp_path / "home", "\n".join(lines), "history.csv")
    spindle = data["temperature"].sel(sensor="sensor.spindle_temperature").values
    assert np.isfinite(spindle[:119]).all() and np.isnan(spindle[119:]).all()
    assert json.loads(data.attrs["held"])[0]["lost"] and json.loads(data.attrs["left_out"]) == []


def test_a_displacement_that_looks_like_a_temperature_is_asked_for(tmp_path: Path) -> None:
    text = rows("{n}.25  {t1}  {t2}").replace("3000.25", "30.25").replace("1500.25", "28.5")
    data = drafted(tmp_path / "folder", text, "log.txt", {"Column of the displacement": "1 = displacement um"})
    assert data.sizes["sensor"] == 2 and data["displacement"].values[0, 0] == pytest.approx(30.25)
    with pytest.raises(DraftError, match="without a displacement"):
        (tmp_path / "folder" / "campaign.toml").unlink()
        write_campaign(tmp_path / "folder", Asker(None))


@pytest.mark.parametrize(("zone", "label"), [("", "no zone  2026-03-09 22:30"), ("UTC", "UTC     2026-03-09 22:30")])
def test_times_without_a_zone_are_said_to_have_none(tmp_path: Path, zone: str, label: str) -> None:
    drafted(tmp_path / "folder", LAYOUTS["date and time"], "log.csv")
    path = tmp_path / "folder" / "campaign.toml"
    path.write_text(
        path.read_text().replace("[campaign]", f'[campaign]\ntime_zone = "{zone}"' if zone else "[campaign]")
    )
    text = "\n".join(check_campaign(path).lines())
    assert label in text and ("carry no zone" in text) == (not zone)


def test_set_points_are_drivers_and_counters_none(tmp_path: Path) -> None:
    lines = [f"{k},{k + 10},{20 + k / 7:.2f},{k / 9:.3f},{60 * (k // 20)},100,{k},5" for k in range(50)]
    names = "time [s],RECORD [RN],T1 [degC],Z [um],bed_target,tool_target,X target [mm],RH [%]"
    (tmp_path / "log.csv").write_text("\n".join([names, *lines]) + "\n")
    roles = {column.heading: column.role for column in propose_table(tmp_path / "log.csv").columns}
    assert roles.pop("bed_target") == "driver"
    assert {roles[name] for name in ("RECORD [RN]", "tool_target", "X target [mm]", "RH [%]")} == {"out"}


def test_counts_are_converted_and_marks_are_no_readings(tmp_path: Path) -> None:
    lines = [
        "time [s],steps,T1",
        *(f"{60 * k},{8 * k - 127},{20 + k / 100 if k != 30 else -180:.2f}" for k in range(60)),
    ]
    lines += ["3600,n.c.,21"]
    answers = {"Column of the displacement": "2 = displacement", "Unit of": "0.0125 mm"}
    data = drafted(tmp_path / "folder", "\n".join(lines), "log.csv", answers)
    np.testing.assert_allclose(data["displacement"].values[:-1, 0], 12.5 * (8 * np.arange(60) - 127))
    assert np.isnan(data["displacement"].values[-1, 0])
    assert np.flatnonzero(np.isnan(data["temperature"].values[:, 0])).tolist() == [30]
    assert load_campaign(tmp_path / "folder" / "campaign.toml").record.missing == (-180,)  # type: ignore[union-attr]


def test_day_and_month_are_told_apart_by_the_shorter_test(tmp_path: Path) -> None:
    """Two days of May: read with the month first they would be a month apart."""
    lines = [f"{6 + k // 24:02d}/05/21-{k % 24:02d}:00:00,{20 + k / 10},{k}" for k in range(36)]
    (tmp_path / "log.csv").write_text("\n".join(["time,T1,Z", *lines]) + "\n")
    table = propose_table(tmp_path / "log.csv")
    assert table.keys["date_order"] == "day first" and table.asked == {}
    # One day says nothing of the order, and is asked about; a year that comes first does.
    for written, asked in (("03/04/2026 {:02d}:00", {"date_order"}), ("2026/03/04-{:02d}:00", set())):
        lines = [f"{written.format(k)},{20 + k / 10},{k}.5" for k in range(24)]
        (tmp_path / "log.csv").write_text("\n".join(["time,T1,Z", *lines]) + "\n")
        assert set(propose_table(tmp_path / "log.csv").asked) == asked


RECORD = """\
[campaign]
title = "A"
[record]
file = "log.csv"
{keys}
"""


@pytest.mark.parametrize(
    ("keys", "error", "message"),
    [
        ('time = "t"\ntime_unit = "s"\ntemperatures = ["frame_t"]\ndisplacements = ["z"]', TableError,
         r'"frame_t" has no unit; write it under \[record.columns\]: "frame_t" = "degC"'),
        ('time = "t"\n[record.columns]\nframe_t = "degC"\nz = "mm"', TableError, 'time_unit = "s"'),
        ('time = "t"\ntime_unit = "s"\n[record.columns]\nframe_t = "degC"', TableError, "no column is a displacement"),
        ('time = "t"\nevery = "2 s"\n[record.columns]\nframe_t = "degC"', CampaignError, "write one of time"),
        ('every = "2 s"\ntemperatures = ["frame_t"]', CampaignError, "needs temperatures = .* and displacements"),
        ('every = "2 s"\nheader_rows = {names = 3, values = 2}\n[record.columns]\nframe_t = "degC"', CampaignError, "begin at line 2"),
        ('every = "2 s"\ntemperatures = ["frame_t"]\ndisplacements = ["z"]\n[record.columns]\nz = {role = "driver", unit = "mm"}',
         CampaignError, "in one of both places"),
    ],
)  # fmt: skip
def test_what_a_record_does_not_say_is_refused_with_the_line_to_add(
    tmp_path: Path, keys: str, error: type[Exception], message: str
) -> None:
    (tmp_path / "log.csv").write_text("t,frame_t,z\n0,20,1\n1,21,2\n")
    (tmp_path / "campaign.toml").write_text(RECORD.format(keys=keys))
    with pytest.raises(error, match=message):
        read_record(load_campaign(tmp_path / "campaign.toml"))


def test_columns_are_corrected_by_number_and_a_named_one_goes_before_a_pattern(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(
        "t,T1,T2,z\n" + "".join(f"{k},{20 + k / 7:.2f},{21 + k / 9:.2f},{k}\n" for k in range(50))
    )
    table = propose_table(tmp_path / "log.csv").corrected("2-3 = temp K; 4 = out")
    assert [(one.role, one.unit) for one in table.columns[1:]] == [
        ("temperature", "K"),
        ("temperature", "K"),
        ("out", "um"),
    ]
    for wrong in ("9 = out", "2 = length", "T1 = out"):
        with pytest.raises(ColumnsError):
            table.corrected(wrong)
    keys = 'every = "1 s"\n[record.columns]\n"T*" = "degC"\nT2 = "degF"\nz = "um"'
    (tmp_path / "campaign.toml").write_text(RECORD.format(keys=keys))
    data = read_record(load_campaign(tmp_path / "campaign.toml"))
    assert data["temperature"].values[0].tolist() == pytest.approx([20.0, (21 - 32) / 1.8])


def test_a_log_of_a_motion_test_is_not_taken_for_a_record(tmp_path: Path) -> None:
    """Position of an axis and a laser's reading over time, by camonitor: no temperature, though one is called ILD_DownSample."""
    lines = [
        f"IOC:{name} 2022-04-06 12:{k // 60:02d}:{k % 60:02d}.1 {value}\n"
        for k in range(600)
        for name, value in (("ILD_DownSample", 70.0891 - 0.01 * k), ("X-PosAct", -20 + 0.01 * k))
    ]
    (tmp_path / "x.log").write_text("".join(lines))
    with pytest.raises(DraftError, match=r"x.log: a table of 2 columns and 1200 rows without a temperature"):
        write_campaign(tmp_path, Asker(None))


@pytest.mark.real_data
def test_a_battery_without_headings_is_asked_about(tmp_path: Path, real_file: Callable[[str], Path]) -> None:
    """Samsung 30Q at 1 C: time, current, voltage, power, temperature, hoop strain, room; only two columns are temperatures."""
    name = "ARTS-Laboratory__dataset-electrothermal-deformation-characterization-for-samsung-30Q-cell/data/S001/Q30_S001_1C.csv"
    table = propose_table(real_file(name))
    assert [one.heading for one in table.of("temperature")] == ["5", "7"]
    assert table.keys["time"] == "1" and table.rows == 3548


def test_inches_mils_and_fahrenheit_are_read_from_headings_and_an_inlet_is_no_inch(tmp_path: Path) -> None:
    minutes = np.arange(120.0)
    warm = 70.0 + 20.0 * (1.0 - np.exp(-minutes / 30.0))
    stamps = pd.Timestamp("2026-03-04 21:30") + pd.to_timedelta(minutes, unit="min")
    table = pd.DataFrame(
        {
            "Date": stamps.strftime("%d-%b-%y"),
            "Time": stamps.strftime("%I:%M %p"),
            "Temp_spindle_F": warm,
            "T_in": warm / 3.0,
            "disp_Z_in": 1e-5 * (warm - 70.0),
            "Y [mil]": 1e-2 * (warm - 70.0),
        }
    )
    table.round(7).to_csv(tmp_path / "log.csv", index=False)
    write_campaign(tmp_path, Asker(None))
    record = read_record(load_campaign(tmp_path / "campaign.toml"))
    assert record["temperature"].sel(sensor="Temp_spindle_F")[0] == pytest.approx((70.0 - 32.0) / 1.8, abs=1e-6)
    assert record["temperature"].sel(sensor="T_in")[0] == pytest.approx(70.0 / 3.0, abs=1e-6)
    last = warm[-1] - 70.0
    assert record["displacement"].sel(channel="disp_Z_in")[-1] == pytest.approx(1e-5 * last * 25.4e3, abs=3e-3)
    assert record["displacement"].sel(channel="Y")[-1] == pytest.approx(1e-2 * last * 25.4, abs=3e-3)
    assert (record["time"].values[[0, -1]] == stamps.values[[0, -1]]).all()


@pytest.mark.parametrize("layout", ["date and time", "klipper", "minutes without a unit", "times of day", "workbook"])
def test_lines_without_a_time_are_left_out_and_named_wherever_they_stand(
    tmp_path: Path, by_hand: xr.Dataset, layout: str
) -> None:
    """An empty time, a second header and a remark in the middle; empty rows and a footer at the end, as spreadsheets export them."""
    of_dates = layout == "workbook"
    text = "time,T1,T2,Z\n" + rows("{time:%Y-%m-%d %H:%M:%S},{t1},{t2},{z}") if of_dates else LAYOUTS[layout]
    mark = ";" if layout == "times of day" else ","
    head, *lines = text.splitlines()
    if layout == "klipper":
        before, head, *lines = text.splitlines()
        text = text.removeprefix(f"{before}\n")
    width = head.count(mark)
    sample = lines[120].split(mark)
    times = {"date and time": (0, 1), "klipper": (1,)}.get(layout, (0,))
    empty = mark.join("" if k in times else value for k, value in enumerate(sample))
    middle = [empty, head, f"Logger restarted{mark * width}"]
    end = [*3 * [mark * width], f"Mean{mark * width}", "End of file"]
    content = [head, *lines[:100], *middle, *lines[100:], *end]
    expected = [102, 103, 104, *range(245, 250)]
    if of_dates:
        sheet = openpyxl.Workbook()
        for line in content:
            # What a spreadsheet calls empty may hold a space.
            sheet.active.append(
                [float(one) if one[:1].isdigit() and "-" not in one else one or " " for one in line.split(mark)]
            )
        sheet.save(tmp_path / "log.xlsx")
        content_bytes = (tmp_path / "log.xlsx").read_bytes()
    else:
        content_bytes = "\n".join(content).encode("cp1252")
    data = drafted(tmp_path / "folder", content_bytes, "log.txt", {"Unit of the times": "min"})
    np.testing.assert_allclose(data["temperature"].values, by_hand["temperature"].values, atol=1e-9)
    np.testing.assert_array_equal(np.diff(data["time"].values), np.diff(by_hand["time"].values))
    assert [one["line"] for one in json.loads(data.attrs["left_out"])] == expected
    proposed = propose_table(tmp_path / "folder" / "log.txt")
    assert proposed.attrs["left_out"] == data.attrs["left_out"]
    assert proposed.rows == 240


@pytest.mark.parametrize("odd", [",,,", "s,degC,degC,mm", "time,T1,T2,Z", "*** spindle started ***", ",21,20,0.001"])
def test_an_odd_row_among_the_first_ones_hides_no_value_above_it(tmp_path: Path, odd: str) -> None:
    first, *others = rows("{time:%Y-%m-%d %H:%M:%S},{t1},{t2},{z}").splitlines()
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["time,T1,T2,Z", first, odd, *others]))
    proposed = propose_table(path)
    assert "header_rows" not in proposed.keys
    assert proposed.rows == 240
    assert [one["line"] for one in json.loads(proposed.attrs["left_out"])] == [3]


def test_rows_without_a_time_below_the_last_one_refuse_no_table(tmp_path: Path) -> None:
    """Two tables side by side, one of them three times as long."""
    path = tmp_path / "log.csv"
    path.write_text("time,T1,Z,other\n" + rows("{time:%Y-%m-%d %H:%M:%S},{t1},{z},1") + 720 * ",,,1\n")
    proposed = propose_table(path)
    assert (proposed.rows, len(json.loads(proposed.attrs["left_out"]))) == (240, 720)
    # Above the last time they are a fault of the column of times.
    path.write_text("time,T1,Z,other\n" + 720 * ",,,1\n" + rows("{time:%Y-%m-%d %H:%M:%S},{t1},{z},1"))
    with pytest.raises(LaserFormatError, match="720 of 960 lines cannot be used"):
        propose_table(path)


@pytest.mark.parametrize(
    ("back", "line", "sorted_"),
    [
        ({}, None, []),
        ("descending", None, []),
        ({120: 118.5, 121: 120}, None, [122]),  # one row is out of place
        ({120: 0}, 122, []),  # restarted: its second half has the times of the first
        ({120: 116}, 122, []),  # set back by four rows
        ("2000", 122, []),
    ],
)
def test_a_clock_that_goes_back_is_refused_unless_single_rows_are_out_of_place(
    tmp_path: Path, back: object, line: int | None, sorted_: list[int]
) -> None:
    place = np.arange(240.0)
    stamps = STAMPS.copy()
    step = STAMPS[1] - STAMPS[0]
    if isinstance(back, dict):
        for at, to in back.items():
            place[at:] = to + np.arange(240 - at)
        stamps = STAMPS[0] + (step * place).astype(step.dtype)
    elif back == "descending":
        stamps = STAMPS[::-1]
    else:
        stamps[120:] += np.datetime64("2000-01-01", "s") - STAMPS[0].astype("M8[s]")
    written = "".join(
        f"{str(at).replace('T', ' ')},{t1},{z}\n" for at, t1, z in zip(stamps, SPINDLE, NOSE, strict=True)
    )
    (tmp_path / "log.csv").write_text(f"time,T1 [degC],Z [mm]\n{written}")
    table = propose_table(tmp_path / "log.csv")
    path, _ = write_campaign(tmp_path, Asker(None))
    if line is not None:
        assert table.refused.startswith(f"line {line}: the clock goes back")
        with pytest.raises(LaserFormatError, match=f"line {line}: the clock goes back"):
            read_record(load_campaign(path))
        return
    data = read_record(load_campaign(path))
    assert table.attrs["clock"] == data.attrs["clock"] and not table.refused
    assert [one["line"] for one in json.loads(data.attrs["clock"])] == sorted_
    assert data.sizes["time"] == 240
    assert (np.diff(data["time"].values).astype(int) >= 0).all()
    assert [notice.code for notice in clock_notices(data)] == ["clock_goes_back"] * bool(sorted_)


@pytest.mark.parametrize(
    ("heading", "times"),
    [
        *((f"time [{unit}]", 1.0 / per) for unit, per in (
            ("ms", 1e-3), ("msec", 1e-3), ("1/100 s", 1e-2), ("s", 1), ("sek", 1), ("ks", 1e3), ("min", 60), ("Stunden", 3600),
            ("h", 3600), ("day", 86400), ("days", 86400), ("d", 86400), ("weeks", 604800),
        )),
        ("t / s", 1.0), ("t/h", 1 / 3600.0), ("Zeit / min", 1 / 60.0), ("t_s", 1.0),
    ],
)  # fmt: skip
def test_a_stated_unit_of_time_is_read(tmp_path: Path, heading: str, times: float) -> None:
    lines = [f"{60.0 * k * times!r},{20 + k / 100},{k}.5" for k in range(300)]
    (tmp_path / "log.csv").write_text("\n".join([f"{heading},T1 [degC],Z [um]", *lines]) + "\n")
    path, _ = write_campaign(tmp_path, Asker(None))
    data = read_record(load_campaign(path))
    seconds = (data["time"].values - data["time"].values[0]) / np.timedelta64(1, "s")
    np.testing.assert_allclose(seconds, 60.0 * np.arange(300), atol=1e-3)
    assert load_campaign(path).record.guessed == ()  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("unit", "of_1970"), [("Excel day", 25569), ("datenum", 719529), ("JD", 2440587.5), ("MJD", 40587)]
)
def test_days_counted_from_a_date_are_told_by_their_numbers_and_marked(
    tmp_path: Path, unit: str, of_1970: float
) -> None:
    """2024-08-01 06:00 is 19936.25 days after 1970."""
    lines = [f"{of_1970 + 19936.25 + k / 1440:.9f},{20 + k / 100},{k}.5" for k in range(300)]
    (tmp_path / "log.csv").write_text("\n".join(["time,T1 [degC],Z [um]", *lines]) + "\n")
    path, _ = write_campaign(tmp_path, Asker(None))
    campaign = load_campaign(path)
    data = read_record(campaign)
    assert abs(data["time"].values[0] - np.datetime64("2024-08-01T06:00")) < np.timedelta64(2, "ms")
    assert abs(data["time"].values[-1] - np.datetime64("2024-08-01T10:59")) < np.timedelta64(2, "ms")
    assert (
        campaign.record is not None and campaign.record.time_unit == unit and campaign.record.guessed == ("time_unit",)
    )
    assert [notice.code for notice in guess_notices(campaign)] == ["units_guessed"]


@pytest.mark.parametrize("unit", ["°C", "ºC", "˚C", "Â°C", "\ufffdC", "oC", "C°", "gradC", "° C", "℃"])
def test_what_looks_like_the_degree_sign_is_one(tmp_path: Path, unit: str) -> None:
    lines = [f"{60 * k},{20 + k / 100},{k}.5" for k in range(100)]
    (tmp_path / "log.csv").write_text("\n".join([f"time [s],T1 [{unit}],Z [um]", *lines]) + "\n")
    assert [column.unit for column in propose_table(tmp_path / "log.csv").of("temperature")] == ["degC"]


def record_of(folder: Path, text: str) -> xr.Dataset:
    """The record that is drafted from a table."""
    folder.mkdir()
    (folder / "log.csv").write_text(text)
    path, asked = write_campaign(folder, Asker(None))
    assert not asked
    return read_record(load_campaign(path))


@pytest.mark.parametrize(
    ("head", "asked"),
    [
        ("time [s],temp bed [centi],T2 [degC],Z [um]", ["temp bed [centi]"]),
        ("time [s],temp x10,T2 [degC],Z x1000 (mm)", ["temp x10", "Z x1000 (mm)"]),
        ("time [s],T1*10,T2/10 [degC],Z (tenths)", ["T1*10", "T2/10 [degC]", "Z (tenths)"]),
        ("time [s],bed (x10 °C),T2 [degC],Z *10^-3 [mm]", ["bed (x10 °C)", "Z *10^-3 [mm]"]),
        ("t [m],T1 [degC],T2 [degC],Z [um]", ["time_unit"]),
        ("time [s],T1 [degC],temperature 2 [mm],Z [um]", ["temperature 2 [mm]"]),
        ("time [s],10*T1 [degC],T2 [degC] x0.1,Z (100 mm)", ["10*T1 [degC]", "T2 [degC] x0.1", "Z (100 mm)"]),
    ],
)
def test_a_unit_or_factor_that_is_not_understood_is_asked(tmp_path: Path, head: str, asked: list[str]) -> None:
    lines = [f"{60 * k},{20 + k / 100},{21 + k / 90},{k}.5" for k in range(100)]
    (tmp_path / "log.csv").write_text("\n".join([head, *lines]) + "\n")
    _, missing = write_campaign(tmp_path, Asker(None))
    assert len(missing) == len(asked) and all(name in line for name, line in zip(asked, missing, strict=True))


def test_what_follows_a_load_and_a_second_clock_are_none_and_degrees_alone_are_asked(tmp_path: Path) -> None:
    lines = [f"{60 * k},{20.1 + k / 100},{21.1 + k / 90},{k}.5,{k / 7},{k / 9},{k}" for k in range(100)]
    (tmp_path / "log.csv").write_text(
        "time [s],T1 [degC],Lager [Grad],Z [um],Strain [µm/m],tilt [arcsec],Runtime [min]\n"
    )
    with (tmp_path / "log.csv").open("a") as file:
        file.write("\n".join(lines))
    roles = {column.heading.split()[0]: column.role for column in propose_table(tmp_path / "log.csv").columns}
    assert roles == {
        "time": "time", "T1": "temperature", "Lager": "temperature", "Z": "displacement", "Strain": "out", "tilt": "out", "Runtime": "out",
    }  # fmt: skip
    _, missing = write_campaign(tmp_path, Asker(None))
    assert len(missing) == 1 and "Lager [Grad]" in missing[0]


def test_runs_and_channels_in_two_units_are_refused_or_asked(tmp_path: Path) -> None:
    for name, unit, factor in (("a.csv", "um", 1.0), ("b.csv", "mm", 1e-3)):
        hour = 8 if unit == "um" else 12
        lines = [f"2026-03-09T{hour + k // 60:02}:{k % 60:02},{20.1 + k / 100},{factor * k}" for k in range(100)]
        (tmp_path / name).write_text("\n".join(["time,T1,Z", f",degC,{unit}", *lines]))
    campaign, _ = write_campaign(tmp_path, Asker(None))
    with pytest.raises(TableError, match=r'b\.csv: "Z" is in mm, in a.csv in um'):
        read_record(load_campaign(campaign))
    changes = [
        f"2026-03-09T08:{k % 60:02},{name},{value},{unit}"
        for k in range(60)
        for name, value, unit in (("T1", 20.1 + k / 100, "degC" if k else ""), ("Z", k, "um" if k < 30 else "nm"))
    ]
    (tmp_path / "long").mkdir()
    (tmp_path / "long/a.csv").write_text("\n".join(["time,channel,value,unit", *changes]))
    _, missing = write_campaign(tmp_path / "long", Asker(None))
    assert len(missing) == 1 and "nm or um" in missing[0]


@pytest.mark.parametrize(
    ("head", "line"),
    [
        ("time [s],T1 (0.1 °C),T2 (m°C),Z (1/10 µm)", "{s},{dT1},{mT2},{dZ}"),
        ('Time (mn),"Temp, °F (LGR S/N: 12, SEN S/N: 7)",T2 [oC],"Z, mm"', "{min},{F1},{T2},{mm}"),
        ("Time,T1,T2,Z", "{min} min,{F1} °F,{T2} °C,{Z} um"),
        ("Time,T1,T2,Z\nmin,°F,°C,µin", "{min},{F1},{T2},{uin}"),
        ("Time,T1,T2,Z,raw Z\n[min],[°F],[°C],[µin],[mV]", "{min},{F1},{T2},{uin},{Z}"),
    ],
)
def test_units_that_are_stated_are_read_wherever_they_stand(tmp_path: Path, head: str, line: str) -> None:
    warm = 1 - np.exp(-np.arange(120) / 30)
    t1, t2, z = 20 + 5 * warm, 21 + 2 * warm, 40 * warm
    lines = [
        line.format(s=60 * k, min=k, dT1=10 * a, F1=1.8 * a + 32, T2=b, mT2=1e3 * b, Z=c, dZ=10 * c, mm=c / 1e3, uin=c / 0.0254)
        for k, (a, b, c) in enumerate(zip(t1, t2, z, strict=True))
    ]  # fmt: skip
    data = record_of(tmp_path / "folder", "\n".join([head, *lines]) + "\n")
    np.testing.assert_allclose(data["temperature"].values, np.stack([t1, t2], axis=1), atol=1e-9)
    np.testing.assert_allclose(data["displacement"].values[:, 0], z, atol=1e-9)
    np.testing.assert_array_equal(np.diff(data["time"].values), np.timedelta64(60, "s"))


@pytest.mark.parametrize(
    "anew", ["time [s],T1 [degF],Z [mm]", "s,degF,mm", "time [s],Z [um],T1 [degC]", "min,T2 (°C),Z (mm)"]
)
def test_a_header_that_changes_the_columns_is_refused_by_its_line(tmp_path: Path, anew: str) -> None:
    lines = [f"{60 * k},{20 + k / 100},{k}.5" for k in range(100)]
    (tmp_path / "log.csv").write_text("\n".join(["time [s],T1 [degC],Z [um]", *lines[:50], anew, *lines[50:]]) + "\n")
    with pytest.raises(TableError, match=r"log.csv, line 52: .* anew"):
        propose_table(tmp_path / "log.csv")


def test_lines_that_sum_up_the_others_and_marks_are_left_out_and_named(tmp_path: Path) -> None:
    """85 degC of a DS18B20 at power-on and -127 when it is lost, OL of a meter, a mean as last line, and its time again."""
    lines = [f"{60 * k},{20 + k / 100:.2f},{21 + k / 90:.3f},{k}.5" for k in range(100)]
    lines[0], lines[40] = "0,85.00,21,0.5", "2400,-127.00,OL,40.5"
    lines += ["6000,20.5,21.5,50 avg", "Mean,20.5,21.5,50", "5940,20.5,21.6,99.5"]
    data = record_of(tmp_path / "folder", "\n".join(["time [s],T1 [degC],T2 [degC],Z [um]", *lines]) + "\n")
    assert data.sizes["time"] == 100 and np.flatnonzero(np.isnan(data["temperature"].values[:, 0])).tolist() == [0, 40]
    left_out, marks = (
        [(one["line"], one["value"]) for one in json.loads(data.attrs[name])] for name in ("left_out", "marks")
    )
    assert left_out == [(102, "50 avg"), (103, "Mean"), (104, "5940")]
    assert sorted(marks) == [(2, "85.0"), (42, "-127.0"), (42, "OL")]


@pytest.mark.parametrize("kind", ["workbook", "text"])
def test_elapsed_times_count_their_hours_beyond_a_day(tmp_path: Path, kind: str) -> None:
    """Excel's [h]:mm:ss of a test of 70 h with a pause of 30 h, and the same as text."""
    hours = np.r_[np.arange(0.0, 20.0, 0.5), np.arange(50.0, 70.5, 0.5)]
    cells = [(timedelta(hours=hour), 20.0 + hour / 30, hour / 8) for hour in hours.tolist()]
    if kind == "workbook":
        sheet = openpyxl.Workbook()
        for row in [("time", "T1 [degC]", "Z [um]"), *cells]:
            sheet.active.append(row)
        sheet.save(tmp_path / "log.xlsx")
    else:
        lines = [
            f"{int(hour)}:{60 * hour % 60:02.0f}:00,{t},{z}\n" for hour, (_, t, z) in zip(hours, cells, strict=True)
        ]
        (tmp_path / "log.csv").write_text("time,T1 [degC],Z [um]\n" + "".join(lines))
    path, _ = write_campaign(tmp_path, Asker(None))
    time = read_record(load_campaign(path))["time"].values
    np.testing.assert_array_equal((time - time[0]) / np.timedelta64(1, "h"), hours)


#: Names, and units where they have a row of their own, above aligned columns of a counter, seconds, two temperatures and a displacement.
ALIGNED = {
    "units in brackets": (("No.", "Time [s]", "T bed [degC]", "T2 (degC)", "X pos [um]"), None),
    "a row of units with blanks": (("No.", "Time", "T bed", "T2 (air)", "X"), ("", "s", "degC", "degC", "um")),
    "a blank name": (("", "Time [s]", "T1 [degC]", "T2 [degC]", "X [um]"), None),
}


@pytest.mark.parametrize(
    ("head", "temperatures", "displacements", "guessed"),
    [
        # A name stands above two columns, the second of which its unit tells.
        (
            "Time,Dendro A,,Dendro B,\n,um,degC,um,degC",
            ["Dendro A [degC]", "Dendro B [degC]"],
            ["Dendro A", "Dendro B"],
            (),
        ),
        # Channels that are called by numbers are no values.
        ("Time,101,102,103,104", ["102", "104"], [], ("101", "102", "103", "104")),
        ("Time,X,T bed,Y,T (air)", ["T bed", "T (air)"], ["X", "Y"], ("X", "T bed", "Y", "T (air)")),
        ("Time,X,TC(1),Y,TC(2)", ["TC(1)", "TC(2)"], ["X", "Y"], ("X", "TC(1)", "Y", "TC(2)")),
        # Balances in kg have the numbers of temperatures.
        ("Time,X [um],Net(1),Y [furlong],T1 [degC]", ["T1 [degC]"], ["X [um]", "Y [furlong]"], ()),
    ],
)
def test_what_only_values_tell_is_marked_and_a_name_that_says_something_else_is_no_temperature(
    tmp_path: Path, head: str, temperatures: list[str], displacements: list[str], guessed: tuple[str, ...]
) -> None:
    lines = [f"{60 * k},{k}.5,{20 + k / 100},{k}.25,{21 + k / 90:.3f}" for k in range(120)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join([head, *lines]).replace("Time", "Time [s]") + "\n")
    table = propose_table(path)
    assert {*temperatures} <= {one.heading for one in table.of("temperature")}
    assert [one.heading for one in table.of("displacement")] == displacements
    assert tuple(one.heading for one in table.columns if one.role != "out" and one.is_guessed) == guessed
    if displacements and "furlong" not in head:
        record = load_campaign(write_campaign(tmp_path, Asker(None))[0]).record
        assert record is not None and record.guessed == guessed


@pytest.mark.parametrize(
    ("heading", "hours"),
    [("Date Time, GMT+02:00", 2), ("Timestamp [UTC]", 0), ("Date-Time (CEST)", 2), ("Time (UTC-5)", -5)],
)
def test_a_zone_in_the_heading_is_that_of_its_times(tmp_path: Path, heading: str, hours: int) -> None:
    (tmp_path / "log.csv").write_text(f'"{heading}",T1 [degC],Z [mm]\n' + rows("{time:%Y-%m-%d %H:%M:%S},{t1},{z}"))
    data = read_record(load_campaign(write_campaign(tmp_path, Asker(None))[0]))
    assert data["time"].values[0] == START - np.timedelta64(hours, "h")
    assert "as the heading says" in str(data["time"].attrs["reference"])


@pytest.mark.parametrize("align", ["<", ">"])
@pytest.mark.parametrize("layout", ALIGNED)
def test_names_and_units_stand_above_their_columns(tmp_path: Path, layout: str, align: str) -> None:
    names, units = ALIGNED[layout]
    values = [
        (str(k), str(60 * k), f"{20 + k / 100:.2f}", "" if k == 7 else f"{21 + k / 90:.2f}", f"{k}.5")
        for k in range(60)
    ]
    lines = ["".join(f"{cell:{align}15}" for cell in row) for row in [names, *([units] if units else []), *values]]
    (tmp_path / "log.txt").write_text("\n".join(["Spindle test", *lines, "End of test"]) + "\n")
    table = propose_table(tmp_path / "log.txt")
    expected = {"T bed [degC]", "T2 (degC)", "T bed", "T2 (air)", "T1 [degC]", "T2 [degC]"} & set(names)
    assert {one.heading for one in table.of("temperature")} == expected
    assert [one.heading for one in table.of("displacement")] == [names[4]]
    assert table.keys["time"] == names[1] and {one.unit for one in table.of("temperature")} == {"degC"}
    (tmp_path / "log.txt").rename(tmp_path / "log.log")
    data = read_record(load_campaign(write_campaign(tmp_path, Asker(None))[0]))
    # An empty cell stays that of its column.
    assert np.flatnonzero(np.isnan(data["temperature"].values).any(axis=1)).tolist() == [7]
    np.testing.assert_allclose(data["displacement"].values[:, 0], np.arange(60) + 0.5)
    assert [one["line"] for one in json.loads(data.attrs["left_out"])] == [63 + bool(units)]


@pytest.mark.parametrize(
    ("heading", "stamp", "time"),
    [("Date Time T1 X", "2026-03-09 22:30:00", ["Date", "Time"]), ("Timestamp T1 X", "2026-03-09 22:30:00", "Timestamp"),
     ("Time T1 X", "10:30:00 PM", "Time")],
)  # fmt: skip
def test_a_date_and_a_time_of_day_may_stand_below_one_name(
    tmp_path: Path, heading: str, stamp: str, time: object
) -> None:
    lines = [f"{stamp.replace(':30:', f':{k:02d}:')} {20 + k / 100:.2f} {k / 1000:.4f}" for k in range(60)]
    (tmp_path / "log.txt").write_text("\n".join([heading, *lines]) + "\n")
    assert propose_table(tmp_path / "log.txt").keys["time"] == time


@pytest.mark.parametrize("heading", ["Time [s] T bed T2 X", "Time T1", "Time T bed T air X\ns degC degC um"])
def test_names_that_differ_in_number_from_their_values_are_refused(tmp_path: Path, heading: str) -> None:
    lines = [f"{60 * k} {20 + k / 100:.2f} {21 + k / 90:.2f} {k}.5" for k in range(60)]
    path = tmp_path / "log.txt"
    path.write_text("\n".join([heading, *lines]) + "\n")
    with pytest.raises(LaserFormatError, match=r"line 1: .* does not name the 4 columns"):
        propose_table(path)
    # A row with an empty cell in columns that are not aligned is left out.
    path.write_text("\n".join(["Time [s] T1 T2 X", *lines[:30], "1800 20.3 30.5", *lines[31:]]) + "\n")
    assert [one["line"] for one in json.loads(propose_table(path).attrs["left_out"])] == [32]


@pytest.mark.parametrize("mark", [",", " "])
def test_a_log_of_more_columns_than_any_has_is_refused_before_it_is_looked_into(tmp_path, mark):
    path = tmp_path / "log.csv"
    path.write_text(f"time{mark}x\n" + f"1{mark}" * 100_000)
    with pytest.raises(LaserFormatError, match=r"log\.csv, line 2: more than 2000 columns"):
        propose_table(path)


@pytest.mark.parametrize(("mark", "decimal"), [(",", "."), (";", ","), ("\t", "."), ("\t", ",")])
def test_marks_between_thousands_of_whole_numbers_are_no_decimal_marks(tmp_path: Path, mark: str, decimal: str) -> None:
    """900 to 1,197 nm, where another column, or the numbers below 1000, tell which mark is which."""
    lines = [
        mark.join(
            f'"{text.replace(".", "_").replace(",", "." if decimal == "," else ",").replace("_", decimal)}"'
            for text in (f"{60 * k}", f"{20 + k / 100:.2f}", f"{900 + 3 * k:,}")
        )
        for k in range(100)
    ]
    (tmp_path / "log.csv").write_text("\n".join([mark.join(["Time [s]", "T1 [degC]", "X [nm]"]), *lines]) + "\n")
    data = read_record(load_campaign(write_campaign(tmp_path, Asker(None))[0]))
    np.testing.assert_allclose(data["displacement"].values[:, 0], 0.9 + 0.003 * np.arange(100))
    np.testing.assert_allclose(data["temperature"].values[:, 0], 20 + np.arange(100) / 100, atol=1e-9)


def table(path: Path, *heading: str, row: str = "{m:.1f},{t1},{z}") -> Path:
    """A table of the test below lines of headings."""
    path.write_text("\n".join(heading) + "\n" + rows(row))
    return path


@pytest.mark.parametrize(
    ("heading", "row", "refused"),
    [
        ("Time [min];T1 [degC];Z [um]", "{m:.1f};{t1};1,{k:03d}", "line 2: '1,000' in the column .* may part thousands or"),
        ("Time_T [min],T1 [degC],Time_Z [min],Z [mm]", "{m},{t1},{m:.0f}{k:03d},{z}", '"Time_T .* and "Time_Z .* do not run alike'),
        ("Time [min],T1 [degC],Time [min],Z [mm]", "{m},{t1},{k}5,{z}", "do not run alike"),
        ("Time [min],T1 [degC],Z [mm]\nmin,degC,um", "{m},{t1},{z}", r'"Z \[mm\]" is in mm by its heading and in um by its row'),
        ("Time [min],T1 [degC],Z [mm]", "{m},{t1},{z} um", r'"Z \[mm\]" is in mm by its heading and in um by its cells'),
    ],
)  # fmt: skip
def test_what_two_places_of_a_table_tell_differently_is_refused(tmp_path: Path, heading: str, row: str, refused: str) -> None:  # fmt: skip
    with pytest.raises((TableError, LaserFormatError), match=refused):
        propose_table(table(tmp_path / "log.csv", heading, row=row))


@pytest.mark.parametrize(
    ("heading", "row", "first"),
    [
        (["t in min,T1 [degC],Z [mm]"], "{m},{t1},{z}", "1970-01-01T00:00"),
        (["Zeit in Min.,T1 [degC],Z [mm]"], "{m},{t1},{z}", "1970-01-01T00:00"),
        (["min,T1 [degC],Z [mm]"], "{m},{t1},{z}", "1970-01-01T00:00"),
        (["time_min,[degC] T1,Z (mm) left"], "{m},{t1},{z}", "1970-01-01T00:00"),
        (["Time - T1 (min),T1 (degC),Time - Z (min),Z (mm)"], "{m},{t1},{m},{z}", "1970-01-01T00:00"),
        (["Time,Temperature [degC],Displacement [mm],", ",front,X,Y"], "{time},{t1},{z},1{z}", "2026-03-09T22:30"),
        (["Time,Temp,Z,U", "min,degC,mm,V"], "{m},{t1},{z},0.1", "1970-01-01T00:00"),
        (["Temperature unit: Fahrenheit", "Length unit: um", "", "Time [min],T1,Z"], "{m},7{t1},{z}", "1970-01-01T00:00"),
        (["Time zone;+02:00;", "", "Time;T1 [degC];Z [mm]"], "{time};{t1};{z}", "2026-03-09T20:30"),
        (["Time zone;Europe/Vienna;", "", "Time;T1 [degC];Z [mm]"], "{time};{t1};{z}", "2026-03-09T21:30"),
        (["Time,ms,T1 [degC],Z [mm]"], "{time:%Y-%m-%d %H:%M},{time:%S}0,{t1},{z}", "2026-03-09T22:30"),
        (["Time [min],Value,Unit,Z,Z Unit"], "{m},{t1},Degree C,{z},mm", "1970-01-01T00:00"),
        (["Time [min],T1 [degC],Z [um]"], "{m},{t1},1’{k:03d}", "1970-01-01T00:00"),
    ],
)  # fmt: skip
def test_units_zones_and_names_are_read_wherever_a_table_states_them(
    tmp_path: Path, heading: list[str], row: str, first: str
) -> None:
    found = propose_table(table(tmp_path / "log.csv", *heading, row=row))
    assert not found.asked and found.time[0] == np.datetime64(first) and found.time.size == MINUTES.size
    assert found.of("temperature") and found.of("displacement") and all(one.told for one in found.of("displacement"))
    assert (found.of("temperature")[0].unit == "degF") == ("Fahrenheit" in heading[0])


def test_what_is_no_reading_of_the_machine_is_not_used(tmp_path: Path) -> None:
    heading = "Date Time,Time (min),Cycle time [s],T1 [degC],T1 std [degC],u(T1) [degC],± [degC],T1 limit [degC],"
    heading += "Dew point [degC],dT/dt [K/min],n [rpm],X position [mm],Z [mm],Z err [mm],Y Last [mm]"
    found = propose_table(
        table(tmp_path / "log.csv", heading, row="{time},{m},3{k},{t1}" + ",0.1{k}" * 6 + ",{n},{k},{z},0.01{k},{z}")
    )
    assert [[one.heading for one in found.of(role)] for role in ("temperature", "displacement", "driver")] == [
        ["T1 [degC]"], ["Z [mm]", "Y Last [mm]"], ["n [rpm]"],
    ]  # fmt: skip


@pytest.mark.parametrize(("text", "order"), [("26.03.09", "year first"), ("26-03-09", "year first"), ("09.03.26", "")])
def test_years_of_two_digits_are_asked_where_the_later_date_has_them_first(
    tmp_path: Path, text: str, order: str
) -> None:
    lines = "".join(f"{text} 08:{k:02d};{20 + k / 7:.2f};{k / 90:.4f}\n" for k in range(60))
    (tmp_path / "log.csv").write_text("Time;T1 [degC];Z [mm]\n" + lines)
    found = propose_table(tmp_path / "log.csv")
    assert found.time[0] == np.datetime64("2026-03-09T08:00") and found.keys.get("date_order", "") == order
    assert ("date_order" in found.asked) == bool(order)


def test_times_that_are_not_understood_are_named(tmp_path: Path) -> None:
    found = propose_table(table(tmp_path / "log.csv", "Time,T1 [degC],Z [mm]", row="8 h past {k},{t1},{z}"))
    assert found.asked["every"] == "'8 h past 0' in the column \"Time\", line 2, is no time that is read"


def test_sheets_of_one_time_belong_together_and_two_runs_are_asked(tmp_path: Path) -> None:
    def book(name: str, **sheets: list[tuple[object, ...]]) -> Path:
        workbook = openpyxl.Workbook()
        for title, lines in sheets.items():
            sheet = workbook.create_sheet(title)
            for line in lines:
                sheet.append(line)
        workbook.remove(workbook.active)
        (tmp_path / name).mkdir()
        workbook.save(tmp_path / name / "log.xlsx")
        return tmp_path / name

    stamps, head = STAMPS.astype(object), ("Time", "T1 [degC]", "Z [mm]")
    hot, moved = (
        [line, *zip(stamps, values, strict=True)] for line, values in ((head[:2], SPINDLE), (head[::2], NOSE))
    )
    apart = book("apart", Notes=[("Mill", 4)], A=hot, B=moved)
    data = read_record(load_campaign(write_campaign(apart, Asker(None))[0]))
    np.testing.assert_allclose(data["displacement"].values[:, 0], 1e3 * NOSE)
    np.testing.assert_allclose(data["temperature"].values[:, 0], SPINDLE)
    lines = [head, *zip(stamps, SPINDLE, NOSE, strict=True)]
    assert propose_table(book("runs", Run1=lines, Run2=lines) / "log.xlsx").asked == {"sheet": "Run2"}


def test_a_logger_lists_its_channels_and_times_above_its_table(tmp_path: Path) -> None:
    """Graphtec's GL820: three rows of dates, spans of channels, units repeated below the names, signs apart from the digits."""
    path = tmp_path / "gl820.csv"
    path.write_text(
        "Vendor,GRAPHTEC Corporation\nStart time,2026-03-09,22:30:00\nEnd time,2026-03-10,00:29:30\nTrigger time,2026-03-09,22:30:00\n"
        'CH,Signal name,Input,Range,Filter,Span\nCH1, "a",TEMP,TC_K,5,70.0,20.0,degC\nCH2, "b",TEMP,TC_K,5,70.0,20.0,degC\nData\n'
        "Number,Date&Time,ms,CH1,CH2,CH3,Alarm1-10,Alarm11-20,AlarmOut\nNO.,Time,ms,degC,degC,mm,A1234567890,A1234567890,A1234\n"
        + rows("{k},{time:%Y/%m/%d %H:%M:%S},0,+  {t1},+  {t2},{z:+7.4f},LLLLLLLLLL,LLLLLLLLLL,LLLL")
    )
    table = propose_table(path)
    assert (table.rows, [one.heading for one in table.of("temperature")]) == (240, ["CH1", "CH2"])
    assert [(one.heading, one.unit) for one in table.of("displacement")] == [("CH3", "mm")]
    assert (table.of("temperature")[0].low, table.of("displacement")[0].high) == (SPINDLE.min(), NOSE.max())


def test_the_first_row_alone_may_hold_what_stands_once(tmp_path: Path) -> None:
    """EasyLog writes its serial number behind the first values: they are no names."""
    path = tmp_path / "easylog.txt"
    lines = rows("{k},{time:%Y-%m-%d %H:%M:%S},{t1},{z}").splitlines()
    path.write_text("\n".join(["shop,Time,Celsius(°C),Growth(mm),Serial Number", f"{lines[0]},0100", *lines[1:]]))
    table = propose_table(path)
    assert (table.rows, table.lacks, table.of("temperature")[0].heading) == (240, "", "Celsius(°C)")


def test_what_is_the_same_on_all_lines_of_a_channel_describes_it(tmp_path: Path) -> None:
    """InfluxDB's annotated CSV, a table for each field; two machines whose fields have one name are not mixed."""
    names = ",result,table,_start,_stop,_time,_value,_field,_measurement,host"
    above = f"#datatype,string,long,dateTime:RFC3339,dateTime:RFC3339,dateTime:RFC3339,double,string,string,string\n{names}\n"
    line = ",,{0},2026-03-09T22:00:00Z,2026-03-10T01:00:00Z,{{time:%Y-%m-%dT%H:%M:%SZ}},{{{1}}},{2},machine,{3}"
    fields = ("t1", "spindle_C"), ("z", "nose_mm")
    (tmp_path / "one.csv").write_text(
        "\n".join(above + rows(line.format(n, key, field, "M1")) for n, (key, field) in enumerate(fields))
    )
    table = propose_table(tmp_path / "one.csv")
    assert table.keys["long"] == {"time": "_time", "channel": "_field", "value": "_value"}
    assert [(one.heading, one.unit) for role in ("temperature", "displacement") for one in table.of(role)] == [
        ("spindle_C", "degC"),
        ("nose_mm", "mm"),
    ]
    both = [rows(line.format(0, key, field, host)) for key, field in fields for host in ("M1", "M2")]
    (tmp_path / "two.csv").write_text(f"{names}\n{''.join(both)}")
    with pytest.raises(
        LaserFormatError, match="one _field differ by host; give those of each host in a file of their own"
    ):
        propose_table(tmp_path / "two.csv")


def test_a_voltage_may_be_the_displacement_and_what_a_volt_is_has_no_default(tmp_path: Path) -> None:
    """A probe on a logger of voltages; words of names may be compound."""
    path = tmp_path / "volts.csv"
    path.write_text("time,spindletemp,Lagertemperatur,CH4 (V)\n" + rows("{time},{t1},{t2},{z}"))
    table = propose_table(path)
    assert (table.may_be_record, [one.unit for one in table.of("temperature")]) == (True, ["degC", "degC"])
    taken = table.corrected("4 = displacement").columns[3]
    assert (taken.unit, taken.remark) == ("V", "unit not known")
    assert table.corrected("4 = displacement 20 um").columns[3].unit == "20 um"


def test_names_with_a_sign_in_brackets_and_sensors_that_are_not_there(tmp_path: Path) -> None:
    """A DIL 805 dilatometer (LightForm-group/dilatometer_modelling_and_constitutive_behaviour), its second sensor unplugged."""
    path = tmp_path / "007.asc"
    head = (
        " C:\\DIL805.PRO\\007.asc\n     No.          Time   Tem.1        DL  Phi  (D)   Tem.2\n"
        "                     s      °C        µm                 °C\n"
    )
    path.write_text(head + rows("{k:8d}  {m:12.6f}   {t1}   {z:8.4f}    0.0001  -220.0"))
    table = propose_table(path)
    assert [one.heading for one in table.columns if one.role != "out"] == ["Time", "Tem.1", "DL"]
    assert next(one.remark for one in table.columns if one.heading == "Tem.2") == "constant"


def test_a_logger_of_japan_is_read_in_its_code_page(tmp_path: Path) -> None:
    text = "日付,時刻,主軸温度,軸受温度,変位(mm)\n" + rows("{time:%Y/%m/%d},{time:%H:%M:%S},{t1},{t2},{z}")
    (tmp_path / "log.csv").write_bytes(text.encode("cp932"))
    table = propose_table(tmp_path / "log.csv")
    assert [(one.heading, one.role) for one in table.columns] == [
        ("日付", "time"), ("時刻", "time"), ("主軸温度", "temperature"), ("軸受温度", "temperature"), ("変位(mm)", "displacement"),
    ]  # fmt: skip


GROWS = np.arange(100.0)


@pytest.mark.parametrize(
    ("heading", "numbers", "role", "unit", "remark"),
    [
        ("T1", 11.0 + GROWS / 100, "temperature", "degC", "unit by its values"),
        ("T bath", 251.0 + GROWS, "temperature", "K", "unit by its values"),
        ("T bath", 250.0 + GROWS, "temperature", "degC", "unit by its values"),
        ("T bath", 351.0 + GROWS, "temperature", "degC", "unit by its values"),
        ("A1", 20.0 + GROWS / 100, "out", "", "by its values"),
        ("A1", 20.0 + GROWS, "out", "", "not known"),
        ("A1", 79.6 + GROWS / 100, "out", "", "not known"),
        ("A1", 11.4 + GROWS / 100, "out", "", "not known"),
        ("A1", GROWS / 1e6, "displacement", "m", "unit by its values"),
        ("Z", 0.5 + 2.0 * GROWS / 99, "displacement", "um", "unit by its values"),
        ("Z", 2e-3 * GROWS / 98, "displacement", "mm", "unit by its values"),
        ("Z", 2e-3 * GROWS / 100, "displacement", "m", "unit by its values"),
        ("Z", GROWS, "displacement", "um", "whole numbers: counts? then one count with its unit, as 0.0125 mm"),
        ("Z", 0.0 * GROWS, "out", "", "constant"),
        ("Z [V]", GROWS / 9, "out", "V", "unit not known"),
        ("Z_um", GROWS / 9, "displacement", "um", ""),
        ("X [um]", 50.0 * GROWS, "displacement", "um", ""),
        ("X [mm]", 20.0 * GROWS / 99, "displacement", "mm", ""),
        ("X [mm]", 20.0 * GROWS / 98, "out", "mm", "moves farther than 20 mm: no thermal displacement"),
        ("T1 [degC]", 20.0 + 0.0 * GROWS, "temperature", "degC", ""),
        ("TC(1)", 20.0 + GROWS / 100, "temperature", "degC", "unit by its values"),
        ("T[1]", 20.0 + GROWS / 100, "temperature", "1", "unit not known"),
        ("Z(1)", 20.0 + GROWS / 100, "displacement", "1", "unit not known"),
        ("duty (1)", GROWS / 100, "driver", "1", ""),
        ("n [1/min]", GROWS, "driver", "1/min", ""),
        ("n", GROWS, "out", "", ""),
        ("RPM", GROWS, "driver", "1/min", ""),
        ("Z", GROWS[:0], "out", "", "no numbers"),
    ],
)  # fmt: skip
def test_role_and_unit_of_a_column(heading: str, numbers: np.ndarray, role: str, unit: str, remark: str) -> None:
    found = _column(heading, "", pd.Series(numbers), numbers)
    assert (found.role, found.unit, found.remark) == (role, unit, remark)
    assert not numbers.size or (found.low, found.high) == (numbers.min(), numbers.max())


@pytest.mark.parametrize(
    ("heading", "numbers", "keys", "asked"),
    [
        ("t", [0.0, 1800.0], {"time_unit": "s"}, ["time_unit"]),
        ("t", [0.0, 1799.0], {"time_unit": "min"}, ["time_unit"]),
        ("t", [0.0, 25.0], {"time_unit": "h"}, ["time_unit"]),
        ("t", [0.0, 2e7], {"time_unit": "ms"}, ["time_unit"]),
        ("t", [85958.0, 100002.0], {"time_format": "%H%M%S"}, ["time_format"]),
        ("t", [1.7e9, 1.7e9 + 60], {"start": "1970-01-01T00:00:00Z", "time_unit": "s"}, []),
        ("t", [1.7e12, 1.7e12 + 6e4], {"start": "1970-01-01T00:00:00Z", "time_unit": "ms"}, []),
        ("t", [3.8e9, 3.8e9 + 60], {"start": "1904-01-01T00:00:00Z", "time_unit": "s"}, ["start"]),
        ("t", [46105.25, 46105.75], {"time_unit": "Excel day"}, ["time_unit"]),
        ("GPS", [1.4e9, 1.4e9 + 60], {"start": "1980-01-05T23:59:42Z", "time_unit": "s"}, []),
    ],
)
def test_times_that_are_numbers_are_placed(
    heading: str, numbers: list[float], keys: dict[str, str], asked: list[str]
) -> None:
    found: tuple[dict[str, str], dict[str, str]] = {}, {}
    _place_times(heading, np.array(numbers), "", *found)
    assert (found[0], list(found[1])) == (keys, asked)


def test_a_number_far_from_all_others_is_a_mark_and_85_degrees_among_others_a_sensor_at_its_start() -> None:
    assert [_is_mark(-999.0, np.array(one)) for one in ([20.0, -999.0], [-940.0, -999.0], [-960.0, -999.0], [1.0])] == [
        True, True, False, False,
    ]  # fmt: skip
    assert _is_mark(-999.0, np.array([-999.0]))
    assert [_power_on(np.array(one)) for one in ([20.0, 85.0, 21.0], [80.0, 85.0, 84.0], [20.0, 20.0, 185.0], [85.0, 20.0])] == [
        85.0, 0.0, 185.0, 0.0,
    ]  # fmt: skip
