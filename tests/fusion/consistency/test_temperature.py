"""Consistency checks of camera and environment log: an emissivity is a slope, a reflection an offset; logs of another course."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.consistency.checks import Check
from fusion.consistency.field_series import field_at, thin_fields
from fusion.consistency.temperature import check_material
from tests.fusion.consistency.twin_fields import SENSOR_MM, recorded, scaled


def checks(factor: float = 1.0, *, seed: int = 5, offset_K: float = 0.0, stated: bool = True) -> dict[str, Check]:
    test = recorded(seed)
    fields = scaled(test.fields, factor)
    fields["frame_temperature"] = fields["frame_temperature"] + offset_K
    return of_log(test.environment, fields, stated=stated)


def of_log(environment: xr.Dataset, fields: xr.Dataset, *, stated: bool) -> dict[str, Check]:
    near = field_at(fields, SENSOR_MM) if stated else thin_fields(fields)
    found = check_material(near, environment, stated=stated, file="environment.csv")
    return {check.code: check for check in found}


@pytest.mark.parametrize("stated", [True, False])
def test_a_sound_camera_passes(stated: bool) -> None:
    found = checks(stated=stated)
    assert found["material_rise"].passed and found["material_level"].passed
    assert found["material_rise"].value == pytest.approx(0.0, abs=0.02)


# The rise grows nearly as the reciprocal of the emissivity: 0.97 over 0.90, over 0.50, and over 1.0.
@pytest.mark.parametrize("factor", [1.078, 1.94, 0.85])
def test_a_wrong_emissivity_is_doubted(factor: float) -> None:
    found = checks(factor)
    assert not found["material_rise"].passed
    assert found["material_rise"].value == pytest.approx(factor - 1.0, abs=0.03)
    assert "emissivity" in found["material_rise"].remedy


def test_pictures_in_reverse_order_run_against_the_log() -> None:
    test = recorded()
    reverse = test.fields.copy(deep=True)
    reverse["frame_temperature"] = reverse["frame_temperature"].copy(data=reverse["frame_temperature"].values[::-1])
    course = of_log(test.environment, reverse, stated=False)["material_course"]
    assert not course.passed and course.value > 0.9
    assert "Check the order, the times and the day of the frames and of the rows of environment.csv" in course.remedy
    assert checks(stated=False)["material_course"].passed


def with_material(environment: xr.Dataset, values: np.ndarray) -> xr.Dataset:
    return environment.assign(material_temperature=environment["material_temperature"].copy(data=values))


@pytest.mark.parametrize("stated", [True, False])
def test_a_log_backwards_or_of_another_hour_is_not_followed(stated: bool) -> None:
    test = recorded()
    material = test.environment["material_temperature"].values
    for values in (material[::-1], np.roll(material, -material.size // 3)):
        course = of_log(with_material(test.environment, values), test.fields, stated=stated)["material_course"]
        assert not course.passed and course.evidence.startswith(
            "The material temperature in environment.csv changes by"
        )


def test_a_sensor_that_stands_still_is_doubted_where_the_table_warms() -> None:
    test = recorded()
    still = with_material(test.environment, np.full(test.environment.sizes["time"], 25.13))
    found = of_log(still, test.fields, stated=True)
    assert [code for code, check in found.items() if not check.passed] == ["material_still"]
    assert "stays at 25.13 degC to the last digit" in found["material_still"].evidence
    early = test.fields.isel(time=slice(0, 14))
    assert of_log(still, early, stated=True)["material_still"].evidence.endswith("cannot be told.")


def test_exchanged_columns_are_named() -> None:
    test = recorded()
    log = test.environment
    air, material = log["air_temperature"].values, log["material_temperature"].values
    exchanged = with_material(log.assign(air_temperature=log["air_temperature"].copy(data=material)), air)
    found = of_log(exchanged, test.fields, stated=True)
    assert not found["environment_columns"].passed and "look exchanged" in found["environment_columns"].evidence
    # What the exchange explains names it before it blames the camera.
    others = [check for code, check in found.items() if not check.passed and code != "environment_columns"]
    assert all(check.remedy.startswith("See environment_columns first") for check in others)
    assert checks()["environment_columns"].passed


def test_a_reflection_changes_the_level_and_not_the_rise() -> None:
    found = checks(offset_K=-22.0)
    assert found["material_rise"].passed and not found["material_level"].passed
    assert "reflected_temperature" in found["material_level"].remedy
    assert found["material_level"].value < -15.0


def test_a_small_change_tells_nothing() -> None:
    test = recorded()
    short = test.fields.isel(time=slice(0, 12))
    found = of_log(test.environment, scaled(short, 1.9), stated=False)
    assert found["material_rise"].passed and "cannot be told" in found["material_rise"].evidence


def test_without_a_log_or_a_field_there_is_no_check() -> None:
    test = recorded()
    assert check_material(None, test.environment, stated=False, file="") == []
    assert check_material(thin_fields(test.fields), None, stated=False, file="") == []
    assert of_log(test.environment.drop_vars("material_temperature"), test.fields, stated=False) == {}
    assert "environment_columns" not in of_log(test.environment.drop_vars("air_temperature"), test.fields, stated=False)
