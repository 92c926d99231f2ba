"""Arrays that stay in their file: what is read is the same as in memory, and every reading has its context."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from thermography.fields.tasks.stored import open_stored


@pytest.fixture
def whole(rng: np.random.Generator) -> xr.Dataset:
    """A Dataset with gaps, times and text."""
    times = np.datetime64("2026-03-09T06:30", "ns") + np.arange(6) * np.timedelta64(90, "s")
    rise = rng.normal(size=(6, 4, 5)).astype("f4")
    rise[2, 1] = np.nan
    return xr.Dataset(
        {"rise": (("cycle", "y", "x"), rise, {"units": "K"}), "name": ("x", list("abcde"))},
        {"cycle": np.arange(1, 7), "time": ("cycle", times)},
    )


def test_what_is_read_is_the_same_as_in_memory(tmp_path: Path, whole: xr.Dataset) -> None:
    whole.to_netcdf(tmp_path / "x.nc", engine="h5netcdf")
    stored = open_stored(tmp_path / "x.nc", nullcontext, 1 << 16)
    xr.testing.assert_identical(stored, whole)
    rise, held = stored["rise"], whole["rise"]
    some = xr.DataArray([0, 3, 1], dims="place")
    for read, expected in (
        (rise[-1, 2, 0], held[-1, 2, 0]),
        (rise.sel(cycle=slice(2, 5), drop=True), held.sel(cycle=slice(2, 5), drop=True)),
        (rise[::2, [3, 0], [1, 4]], held[::2, [3, 0], [1, 4]]),
        (rise.isel(x=some, y=some), held.isel(x=some, y=some)),
        (rise[1:][:, 1][2], held[1:][:, 1][2]),
    ):
        np.testing.assert_array_equal(read.values, expected.values)
    assert not rise.variable._in_memory
    stored.close()


def test_every_reading_has_its_context(tmp_path: Path, whole: xr.Dataset) -> None:
    begun: list[int] = []

    @contextmanager
    def noted() -> Iterator[None]:
        begun.append(0)
        yield

    whole.to_netcdf(tmp_path / "x.nc", engine="h5netcdf")
    stored = open_stored(tmp_path / "x.nc", noted, 1 << 16)
    assert len(begun) == 1
    for at in range(3):
        assert stored["rise"].variable[at].values.shape == (4, 5)
    assert len(begun) == 4
    stored.close()
