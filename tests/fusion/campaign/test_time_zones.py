"""Times without a zone: brought to UTC by the stated zone, refused where clocks are changed or kinds are mixed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.campaign.config import CampaignError, load_campaign
from fusion.campaign.inputs import read_record, read_source
from fusion.campaign.time_zones import bring_to_utc, lacks_zone, refuse_mixed_zones, time_part, zone_notices
from fusion.results.parts import TimePart
from interferometry.io.tables import NO_ZONE
from tests.fusion.campaign_parts import change


def table(*times: str, reference: str = NO_ZONE) -> xr.Dataset:
    dataset = xr.Dataset(coords={"time": np.array(times, "datetime64[ns]")})
    dataset["time"].attrs["reference"] = reference
    return dataset


def test_local_times_become_utc_in_winter_and_in_summer() -> None:
    local = table("2026-01-15T10:00", "2026-07-15T10:00", "NaT")
    placed = bring_to_utc(local, "Europe/Vienna", file="laser.csv")
    expected = np.array(["2026-01-15T09:00", "2026-07-15T08:00", "NaT"], "datetime64[ns]")
    np.testing.assert_array_equal(placed["time"].values, expected)
    assert placed["time"].attrs["reference"] == "converted to UTC from Europe/Vienna"
    assert lacks_zone(local) and not lacks_zone(placed)


def test_times_with_a_zone_or_without_a_stated_one_stay() -> None:
    zoned = table("2026-07-15T10:00", reference="UTC in the file")
    assert bring_to_utc(zoned, "Europe/Vienna", file="") is zoned
    bare = table("2026-07-15T10:00")
    assert bring_to_utc(bare, None, file="") is bare
    late = bring_to_utc(bare, None, file="", late_s=60.0)
    assert late["time"].values == np.datetime64("2026-07-15T09:59") and lacks_zone(late)


@pytest.mark.parametrize(
    ("reference", "stated", "zone"),
    [(NO_ZONE, None, ""), (NO_ZONE, "Europe/Vienna", "Europe/Vienna"), ("UTC in the file", None, None)],
)
def test_readings_have_a_first_and_a_last_time_in_a_zone_where_they_have_dates(
    reference: str, stated: str | None, zone: str | None
) -> None:
    dated = table("NaT", "2026-07-15T10:00", "2026-07-15T09:00", reference=reference)
    assert time_part(dated, stated) == TimePart(first="2026-07-15T09:00:00Z", last="2026-07-15T10:00:00Z", zone=zone)
    assert len([*zone_notices(dated, code="no_zone", of="laser.csv")]) == (reference == NO_ZONE)
    counted = table("NaT", "1970-01-01T01:00", reference=reference)
    assert time_part(counted, stated) is None and not [*zone_notices(counted, code="no_zone", of="laser.csv")]


@pytest.mark.parametrize("time", ["2026-10-25T02:30", "2026-03-29T02:30"])
def test_the_hour_in_which_clocks_are_changed_is_refused(time: str) -> None:
    with pytest.raises(CampaignError, match=rf"drivers.csv: 2 times, the first {time}:00, .* in Europe/Vienna.*in UTC"):
        bring_to_utc(table("2026-03-01T10:00", time, f"{time}:10"), "Europe/Vienna", file="drivers.csv")


def test_logs_with_and_without_a_zone_are_not_mixed() -> None:
    bare, zoned = table("2026-03-09T06:30"), table("2026-03-09T06:30", reference="UTC in the file")
    refuse_mixed_zones({"laser.csv": bare, "drivers.csv": bare}, source="campaign.toml")
    refuse_mixed_zones({"laser.csv": zoned, "drivers.csv": zoned, "empty.dat": table("NaT")}, source="campaign.toml")
    with pytest.raises(CampaignError, match=r"laser.csv gives .* without a zone, drivers.csv with one; .*time_zone = "):
        refuse_mixed_zones({"laser.csv": bare, "drivers.csv": zoned}, source="campaign.toml")


def drop_zone(path: Path, hours: int) -> None:
    """Write the times of a file in a local time that is ahead of UTC, without its zone."""
    lines = path.read_text(encoding="utf-8").splitlines()
    column = lines[0].split(",").index("time")
    for k, line in enumerate(lines[1:], 1):
        fields = line.split(",")
        local = np.datetime64(fields[column].split("+")[0]) + np.timedelta64(hours, "h")
        fields[column] = str(local)
        lines[k] = ",".join(fields)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def test_a_laser_log_in_local_time_is_refused_or_put_right_by_its_zone(copied: Path) -> None:
    sound = read_source(load_campaign(copied / "campaign.toml"))
    drop_zone(copied / "laser.csv", 1)
    path = copied / "campaign.toml"
    with pytest.raises(CampaignError, match=r"laser.csv gives .* a zone, environment.csv, drivers.csv with one"):
        read_source(load_campaign(path))
    change(path, "[interferometry]\n", '[interferometry]\ntime_zone = "Europe/Vienna"\n')
    placed = read_source(load_campaign(path))
    np.testing.assert_array_equal(placed.deviations["time"], sound.deviations["time"])
    with pytest.raises(CampaignError, match=r"time_zone = \"Europe/Wien\": there is no such time zone; did you mean"):
        load_campaign(change(path, "Europe/Vienna", "Europe/Wien"))


def test_a_campaign_without_any_zone_goes_on_as_one_clock(copied: Path) -> None:
    for name in ("laser.csv", "environment.csv", "drivers.csv"):
        drop_zone(copied / name, 0)
    assert lacks_zone(read_source(load_campaign(copied / "campaign.toml")).deviations)


def test_a_record_in_local_time(tmp_path: Path) -> None:
    rows = "\n".join(f"2026-07-01 10:{minute:02d},20.0,1.0" for minute in range(5))
    (tmp_path / "record.csv").write_text(f"stamp,t1 [degC],z [um]\n{rows}\n", encoding="utf-8")
    text = '[campaign]\ntitle = "A"\ntime_zone = "Europe/Vienna"\n[record]\nfile = "record.csv"\ntime = "stamp"\n'
    (tmp_path / "c.toml").write_text(
        text + 'temperatures = ["t1 [degC]"]\ndisplacements = ["z [um]"]\n', encoding="utf-8"
    )
    times = read_record(load_campaign(tmp_path / "c.toml"))["time"].values
    assert times[0] == np.datetime64("2026-07-01T08:00")
