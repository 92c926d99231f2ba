"""Tests of the tables that a campaign needs: any subset of the instruments is taken, and what a table lacks is named."""

from __future__ import annotations

from typing import Any

import pytest

from fusion.campaign.needed_tables import check_tables

LASER: dict[str, Any] = {"interferometry": {}}
CAMERA: dict[str, Any] = {"thermography": {}, "plan": {"size": [], "cell_size": "", "fiducials": ""}}
AXIS: dict[str, Any] = {"axis": {}}
PICTURE: dict[str, Any] = {"thermography": {}, "plan": {"registration": "pixels"}}
SENSORS: dict[str, Any] = {"sensors": {}, "plan": {"size": [], **AXIS}}


def check(*tables: dict[str, Any]) -> list[str]:
    content = {name: keys for table in tables for name, keys in table.items()}
    return check_tables(content, lambda key: ".".join(key) or "file")


@pytest.mark.parametrize(
    "tables",
    [
        (LASER,),
        (LASER, {"plan": {"size": []}}),
        (CAMERA,),
        (PICTURE,),
        ({**PICTURE, "plan": {**PICTURE["plan"], "cell_px": "4 px"}},),
        (LASER, CAMERA, {"plan": {**CAMERA["plan"], **AXIS}}),
        (LASER, SENSORS),
        ({"record": {}},),
    ],
)
def test_any_subset_of_the_instruments_is_a_campaign(tables: tuple[dict[str, Any], ...]) -> None:
    assert check(*tables) == []


@pytest.mark.parametrize(
    ("tables", "fault"),
    [
        ((), "file: there is no instrument"),
        ((SENSORS,), "file: there is no instrument"),
        (({"thermography": {}},), "thermography: [thermography] needs the table [plan]"),
        ((LASER, {"sensors": {}}), "sensors: [sensors] needs the table [plan]"),
        ((CAMERA, {"plan": {"size": [], "cell_size": ""}}), "plan: [plan] lacks fiducials; add it"),
        ((LASER, CAMERA), "plan: [plan] lacks axis; add it"),
        ((CAMERA, {"thermography": {"table": "moving"}}), "plan: [plan] lacks axis; add it"),
        (
            (LASER, CAMERA, {"plan": {**CAMERA["plan"], **AXIS}}, {"thermography": {"window": "5 min"}}),
            "thermography.window: thermography.window divides the frames where no laser gives cycles",
        ),
        ((CAMERA, {"plan": {"cell_size": "", "fiducials": ""}}), "plan: [plan] lacks size; add it"),
        ((CAMERA, {"plan": {**CAMERA["plan"], "cell_px": ""}}), "plan.cell_px: cell_px belongs to a plan of pixels"),
        (
            (LASER, PICTURE),
            'interferometry: plan.registration = "pixels", but [interferometry] needs the measured line',
        ),
        (
            (PICTURE, {"sensors": {}}),
            'sensors: plan.registration = "pixels", but [sensors] needs the places of the sensors',
        ),
        (({"plan": PICTURE["plan"]}, LASER), "plan.registration: "),
        ((PICTURE, {"thermography": {"table": "moving"}}), 'thermography.table: plan.registration = "pixels"'),
        ((PICTURE, {"thermography": {"lens": ""}}), 'thermography.lens: plan.registration = "pixels"'),
        *(
            (
                (PICTURE, {"plan": {**PICTURE["plan"], name: ""}}),
                f'plan.{name}: plan.{name} beside plan.registration = "pixels"',
            )
            for name in ("size", "cell_size", "fiducials", "regions", "axis")
        ),
        ((LASER, {"record": {}}), "record: [record] stands instead of [interferometry]"),
        (({"path": ""},), "path: unknown key path"),
    ],
)
def test_what_a_campaign_lacks_is_named(tables: tuple[dict[str, Any], ...], fault: str) -> None:
    (found,) = check(*tables)
    assert found.startswith(fault)
