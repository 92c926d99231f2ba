"""Consistency checks of the camera's rise and level: an emissivity is a slope, a reflection an offset."""

from __future__ import annotations

import pytest

from fusion.consistency.checks import Check
from fusion.consistency.field_series import field_at, thin_fields
from fusion.consistency.temperature import check_material
from tests.fusion.consistency.twin_fields import SENSOR_MM, recorded, scaled


def checks(factor: float = 1.0, *, seed: int = 5, offset_K: float = 0.0, stated: bool = True) -> dict[str, Check]:
    test = recorded(seed)
    fields = scaled(test.fields, factor)
    fields["frame_temperature"] = fields["frame_temperature"] + offset_K
    near = field_at(fields, SENSOR_MM) if stated else thin_fields(fields)
    found = check_material(near, test.environment, stated=stated)
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
    (course,) = (
        check
        for check in check_material(thin_fields(reverse), test.environment, stated=False)
        if check.code == "material_course"
    )
    assert not course.passed and course.value < -0.5
    assert "order and the times of the frames" in course.remedy
    assert checks(stated=False)["material_course"].passed


def test_a_reflection_changes_the_level_and_not_the_rise() -> None:
    found = checks(offset_K=-22.0)
    assert found["material_rise"].passed and not found["material_level"].passed
    assert "reflected_temperature" in found["material_level"].remedy
    assert found["material_level"].value < -15.0


def test_a_small_change_tells_nothing() -> None:
    test = recorded()
    short = test.fields.isel(time=slice(0, 12))
    found = {
        check.code: check for check in check_material(thin_fields(scaled(short, 1.9)), test.environment, stated=False)
    }
    assert found["material_rise"].passed and "cannot be told" in found["material_rise"].evidence


def test_without_a_log_or_a_field_there_is_no_check() -> None:
    test = recorded()
    assert check_material(None, test.environment, stated=False) == []
    assert check_material(thin_fields(test.fields), None, stated=False) == []
    assert (
        check_material(thin_fields(test.fields), test.environment.drop_vars("material_temperature"), stated=False) == []
    )
