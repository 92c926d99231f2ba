"""Stacks as zarr: bit-exact, and written as a whole or not at all."""

import numpy as np
import pytest
import xarray as xr

from thermography.io.zarr_stack import StackError, open_stack, write_stack


@pytest.fixture
def stack(rng):
    values = rng.normal(25, 1, (150, 36, 140)).astype(np.float32)
    values[:, 3:5, 7:9] = np.nan
    times = np.datetime64("2026-03-09T06:00:00.123", "ns") + np.arange(150) * np.timedelta64(10_007, "ms")
    coords = {"time": times, "y": np.arange(36) * 5.0 + 2.5, "x": np.arange(140) * 5.0 + 2.5}
    attrs = {"units": "degC", "units_metadata": "temperature: on_scale"}
    return xr.DataArray(values, dims=("time", "y", "x"), coords=coords, attrs=attrs, name="frame_temperature")


def test_stack_comes_back_bit_for_bit(stack, tmp_path):
    write_stack(tmp_path / "film.zarr", stack)
    back = open_stack(tmp_path / "film.zarr")
    assert back.name == "frame_temperature"
    assert back.values.tobytes() == stack.values.tobytes()
    xr.testing.assert_identical(back.coords["time"].drop_attrs(), stack.coords["time"])
    assert back.attrs == stack.attrs
    assert back.isel(x=3, y=2).values.tolist() == stack.isel(x=3, y=2).values.tolist()
    assert [p.name for p in tmp_path.iterdir()] == ["film.zarr"]


def test_what_is_not_a_stack_is_refused(stack, tmp_path):
    write_stack(tmp_path / "film.zarr", stack[:3])
    with pytest.raises(StackError, match="already exists; choose another name"):
        write_stack(tmp_path / "film.zarr", stack[:3])
    with pytest.raises(StackError, match=r"a stack is \(time, y, x\)"):
        write_stack(tmp_path / "one.zarr", stack[0])
    with pytest.raises(StackError, match="is not a stack of fields"):
        open_stack(tmp_path / "none.zarr")
