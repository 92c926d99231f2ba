"""Contact sensors of a campaign file: read in degC, each with its place on the plan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import load_campaign
from fusion.campaign.logged_tables import TableError
from fusion.campaign.sensors import ContactSensors, read_sensors
from tests.fusion.campaign_parts import without

SENSORS = '\n[sensors]\nfile = "sensors.csv"\nplaces = "places.csv"\n'
LOG = "time,t1 [degC],t2 [K]\n2026-03-09T08:00:00Z,20.0,293.15\n2026-03-09T08:01:00Z,20.5,293.35\n"
PLACES = "name,x_mm,y_mm\nt1,500,90\nt2,200,90\n"


def read(folder: Path, log: str = LOG, places: str = PLACES) -> ContactSensors | None:
    (folder / "sensors.csv").write_text(log, encoding="utf-8")
    (folder / "places.csv").write_text(places, encoding="utf-8")
    return read_sensors(load_campaign(without(folder / "campaign.toml", "thermography", added=SENSORS)))


def test_temperatures_are_read_with_their_places(copied: Path) -> None:
    sensors = read(copied)
    assert sensors is not None and sensors.names == ["t1", "t2"]
    assert sensors.temperature.values[-1].tolist() == pytest.approx([20.5, 20.2])
    assert sensors.x_mm.tolist() == [500.0, 200.0] and sensors.u_K == 0.2


@pytest.mark.parametrize(
    ("log", "places", "fault"),
    [
        (LOG.replace("[K]", "[bar]"), PLACES, 'the column "t2"'),
        (LOG, PLACES.replace("t2,", "t3,"), "t2, t3 stands in only one of both files"),
        (LOG, PLACES.replace("200,90", "900,90"), "line 3: x 900 mm, y 90 mm lies beside the plan of 700 x 180 mm"),
        (LOG, PLACES.replace("200,90", "left,90"), "line 3: .*write the place in mm"),
    ],
)
def test_what_does_not_fit_is_named(copied: Path, log: str, places: str, fault: str) -> None:
    with pytest.raises(TableError, match=fault):
        read(copied, log, places)


def long_log(*, broken: bool) -> str:
    """Two hours of three sensors, of which the second may jump by 15 K half way."""
    minutes = np.arange(120)
    warm = 20.0 + 4.0 * (1.0 - np.exp(-minutes / 40.0))[:, None] * np.array([1.0, 0.8, 0.9])
    warm += np.random.default_rng(2).normal(0.0, 0.02, warm.shape)
    warm[60:, 1] += 15.0 if broken else 0.0
    stamps = np.datetime64("2026-03-09T08:00:00") + 60 * minutes
    rows = [f"{stamp}Z,{a:.3f},{b:.3f},{c:.3f}" for stamp, (a, b, c) in zip(stamps, warm, strict=True)]
    return "\n".join(["time,t1 [degC],t2 [degC],t3 [degC]", *rows]) + "\n"


def test_a_sensor_that_breaks_is_left_out_and_named(copied: Path) -> None:
    places = PLACES + "t3,350,90\n"
    whole = read(copied, long_log(broken=False), places)
    assert whole is not None and whole.faults == () and whole.names == ["t1", "t2", "t3"]
    sensors = read(copied, long_log(broken=True), places)
    assert sensors is not None and sensors.names == ["t1", "t3"] and sensors.x_mm.tolist() == [500.0, 350.0]
    (fault,) = sensors.faults
    assert fault.sensor == 1 and "jumps by 15 K" in fault.words and fault.onset_s == pytest.approx(3600.0, abs=120.0)
    # The others keep every sample.
    assert sensors.temperature.shape == (120, 2) and sensors.logged.shape == (120, 3)


def test_a_campaign_without_sensors_has_none(copied: Path) -> None:
    assert read_sensors(load_campaign(copied / "campaign.toml")) is None
