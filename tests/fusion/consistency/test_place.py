"""What the frames show over the series: stretches without a check of the place, frames left out or repeated, parts that jump."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr

from fusion.consistency.checks import Check
from fusion.consistency.place import check_gaps, check_place, find_gaps, gap_words

START = np.datetime64("2026-03-09T06:30", "ns")
FRAMES, ROWS, COLUMNS = 40, 9, 35


def fields(change_K: np.ndarray | None = None, **remarks: list) -> xr.Dataset:
    """A table that warms smoothly by 5 K at one end, with a source that is switched at frame 15, and 20 mK of noise."""
    rng = np.random.default_rng(4)
    minutes = 4.2 * np.arange(FRAMES)
    place = np.linspace(0.0, 1.0, COLUMNS)
    warm = 5.0 * (1.0 - np.exp(-minutes / 60.0))[:, None, None] * place
    late = np.maximum(minutes - 63.0, 0.0)[:, None, None] / 60.0 * np.exp(-(((place - 0.3) / 0.1) ** 2))
    stack = 23.0 + warm + late + rng.normal(0.0, 0.02, (FRAMES, ROWS, COLUMNS))
    lists = ("knocks", "unchecked_stretches", "frames_damaged", "frames_obstructed", "frames_shaken", "frames_repeated")
    attrs: dict[str, list] = {name: [] for name in lists}
    return xr.Dataset(
        {
            "frame_temperature": (("time", "y", "x"), stack if change_K is None else stack + change_K),
            "frame_count": ("time", np.ones(FRAMES, int)),
        },
        coords={
            "time": START + np.round(60e9 * minutes).astype("m8[ns]"),
            "y": 20.0 * np.arange(ROWS),
            "x": 20.0 * np.arange(COLUMNS),
        },
        attrs={name: json.dumps(value) for name, value in (attrs | remarks).items()},
    )


def failed(dataset: xr.Dataset) -> dict[str, Check]:
    return {check.code: check for check in check_place(dataset) if not check.passed}


def test_a_sound_series_passes() -> None:
    assert failed(fields()) == {}
    assert len(check_place(fields())) == 4
    assert check_place(fields().drop_attrs()) == []


def test_a_common_step_of_the_camera_is_no_jump_of_a_part() -> None:
    step = np.where(np.arange(FRAMES) < 20, 0.0, 0.8)[:, None, None]
    assert failed(fields(step)) == {}


def test_a_reflection_on_a_part_of_the_table_is_doubted_with_place_size_and_time() -> None:
    lit = np.zeros((FRAMES, ROWS, COLUMNS))
    lit[18:28, 2:6, 10:16] = 1.0
    check = failed(fields(lit))["scene_change"]
    assert check.value == pytest.approx(24 / (ROWS * COLUMNS), abs=0.01)
    assert "around x = 250 mm, y = 70 mm jumps by +1.0 K" in check.evidence
    assert "at 2026-03-09T07:45:36Z: a reflection, an object on the table or a blurred view" in check.evidence
    assert check.evidence.endswith("(2 jumps in all).")


def test_a_long_stretch_without_a_check_is_doubted_and_named() -> None:
    stretch = {"first": "a.jpg#0", "last": "b.jpg#0", "frames": 8}
    check = failed(fields(unchecked_stretches=[stretch]))["camera_place"]
    assert check.value == pytest.approx(0.2) and "a.jpg#0 to b.jpg#0 (8 frames)" in check.evidence
    assert failed(fields(unchecked_stretches=[stretch | {"frames": 2}])) == {}


def test_many_frames_left_out_or_repeated_are_doubted() -> None:
    names = [f"{i}.jpg#0" for i in range(30)]
    left_out = failed(fields(frames_obstructed=names[:20], frames_shaken=names[20:22]))["frames_left_out"]
    assert left_out.evidence.startswith(
        "35 % of 62 frames were left out: 20 with something before the table, 2 displaced alone"
    )
    repeated = failed(fields(frames_repeated=names[:10]))["frames_repeated"]
    assert (
        repeated.evidence
        == "10 of 40 frames hold the image of the frame before, 0.jpg#0 to 9.jpg#0: the camera was frozen."
    )


def moving(across_mm: np.ndarray, **remarks: list) -> xr.Dataset:
    """A table that moves, located in every frame to 0.03 mm."""
    rng = np.random.default_rng(5)
    across = across_mm + rng.normal(0.0, 0.03, len(across_mm))
    base = fields(**remarks).drop_vars("frame_temperature")
    times = START + 10 * np.arange(len(across)) * np.timedelta64(1, "s")
    return base.assign(table_across=("frame_time", across)).assign_coords(frame_time=times)


def test_a_moving_table_is_not_displaced_across_its_axis_nor_lost() -> None:
    straight = 0.02 * np.sin(np.arange(200) / 7.0)
    assert failed(moving(straight)) == {}
    knocked = failed(moving(straight + 0.6 * (np.arange(200) >= 120)))
    assert set(knocked) == {"camera_place"}
    assert (
        "by +0.6" in knocked["camera_place"].evidence
        and "from 2026-03-09T06:50:00Z on" in knocked["camera_place"].evidence
    )
    lost = failed(moving(straight, frames_unplaced=[f"a.seq#{i}" for i in range(60)]))
    assert "60 in which the moving table is not located" in lost["frames_left_out"].evidence
    assert failed(moving(straight[:4])) == {}


def test_readings_in_a_gap_between_frames_are_counted() -> None:
    dataset = fields()
    readings = xr.DataArray(dataset["time"].values[:, None] + np.array([30, 60], "m8[s]"), dims=("cycle", "target"))
    (sound,) = check_gaps(dataset["time"].values, readings)
    assert sound.passed and sound.value == 0.0
    kept = np.delete(dataset["time"].values, np.arange(14, 23))
    (check,) = check_gaps(kept, readings)
    # Nine frames are missing, so that ten intervals of 4.2 min lie between the frames about them.
    assert not check.passed and check.value == 0.25
    assert "42 min from 2026-03-09T07:24:36Z to 2026-03-09T08:06:36Z" in check.evidence
    assert [gap_words(gap) for gap in find_gaps(kept)] == ["42 min from 2026-03-09T07:24:36Z to 2026-03-09T08:06:36Z"]
    assert check_gaps(np.delete(kept, np.arange(1, len(kept))), readings)[0].passed


def test_a_long_series_is_checked_piece_by_piece_with_the_same_result(monkeypatch: pytest.MonkeyPatch) -> None:
    lit = np.zeros((FRAMES, ROWS, COLUMNS))
    lit[18:28, 2:6, 10:16] = 1.0
    lit[:, 0, :3] = np.nan
    at_once = [check_place(fields(change_K)) for change_K in (None, lit)]
    monkeypatch.setattr("thermography.fields.tasks.pieces.PIECE_BYTES", 7 * 8 * ROWS * COLUMNS)
    assert [check_place(fields(change_K)) for change_K in (None, lit)] == at_once
