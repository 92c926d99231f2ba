"""OpenEXR maps: bit-exact, and written as a whole or not at all."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from thermography.io.openexr import ExrError, read_maps, write_maps


def test_maps_read_back_bit_for_bit_with_nan_and_odd_layout(rng, tmp_path):
    temperature = rng.normal(25, 3, (36, 140))
    temperature[3:6, 10:14] = np.nan
    transposed = np.asfortranarray(rng.normal(0, 1, (36, 140)).astype(np.float32))[:, ::-1]
    path = tmp_path / "cycle.exr"
    write_maps(path, {"temperature": temperature, "rise": transposed})
    back = read_maps(path)
    assert back["temperature"].tobytes() == temperature.astype(np.float32).tobytes()
    assert back["rise"].tobytes() == np.ascontiguousarray(transposed).tobytes()
    assert (back["mask"] == np.isfinite(temperature)).all()
    assert [p.name for p in tmp_path.iterdir()] == ["cycle.exr"]


def test_every_quantity_is_a_part_with_one_channel(tmp_path):
    path = tmp_path / "cycle.exr"
    write_maps(path, {"temperature": np.ones((4, 5)), "mask": np.zeros((4, 5))})
    parts = OpenEXR.File(str(path)).parts
    assert [part.name() for part in parts] == ["temperature", "mask"]
    assert [list(part.channels) for part in parts] == [["Y"], ["Y"]]
    assert read_maps(path)["mask"].max() == 0


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        ({}, "there is no map to write"),
        ({"a": np.ones((2, 3)), "b": np.ones((3, 2))}, "the maps differ in shape"),
        ({"a": np.ones(3)}, r"a has shape \(3,\); a map is \(y, x\)"),
        ({"a": np.full((2, 2), 1e300)}, "a holds 1e\\+300, which float32 cannot represent"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, maps, message):
    with pytest.raises(ExrError, match=message):
        write_maps(tmp_path / "x.exr", maps)
    assert not list(tmp_path.iterdir())


def test_what_is_not_a_map_file_is_refused(tmp_path):
    with pytest.raises(ExrError, match="there is no such file"):
        read_maps(tmp_path / "none.exr")
    (tmp_path / "text.exr").write_text("not an image")
    with pytest.raises(ExrError, match="is not an OpenEXR file"):
        read_maps(tmp_path / "text.exr")


def test_a_file_that_does_not_read_back_is_not_left_behind(tmp_path, monkeypatch):
    monkeypatch.setattr("thermography.io.openexr.read_maps", lambda path: {"a": np.zeros((2, 2), np.float32)})
    with pytest.raises(ExrError, match="a does not read back as it was written"):
        write_maps(tmp_path / "x.exr", {"a": np.ones((2, 2))})
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        def __init__(self, parts: object) -> None:
            pass

        def write(self, path: str) -> None:
            raise RuntimeError("No space left on device.")

    monkeypatch.setattr("OpenEXR.File", Full)
    with pytest.raises(ExrError, match=r"cycle_0001\.exr: cannot be written \(No space left on device\.\); make room"):
        write_maps(tmp_path / "cycle_0001.exr", {"rise": np.zeros((2, 3))})
    assert list(tmp_path.iterdir()) == []
