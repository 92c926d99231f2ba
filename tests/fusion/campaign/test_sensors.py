"""Contact sensors of a campaign file: read in degC, each with its place on the plan."""

from __future__ import annotations

from pathlib import Path

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


def test_a_campaign_without_sensors_has_none(copied: Path) -> None:
    assert read_sensors(load_campaign(copied / "campaign.toml")) is None
