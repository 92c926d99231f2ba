"""Products on disk: files are whole or absent, a stage is done once, Datasets come back equal."""

from __future__ import annotations

import errno
import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import xarray as xr

from fusion.results import store
from fusion.results.store import (
    ContractError,
    DamagedProductError,
    OutputError,
    StageStamps,
    annotate,
    by_approach,
    check,
    digest,
    file_sha256,
    finished_stages,
    group,
    has,
    has_product,
    in_groups,
    is_large,
    joined,
    noted_messages,
    open_dataset,
    plain,
    read_dataset,
    read_fusion,
    read_json,
    read_json_object,
    read_product,
    read_tree,
    require_own,
    write_atomically,
    write_dataset,
    write_json,
)
from thermography.large_arrays import in_pieces


def test_json_has_no_nan_and_times_are_utc(tmp_path: Path) -> None:
    path = write_json(
        tmp_path / "x.json",
        {"a": np.float64("nan"), "b": np.array([1.5, np.inf]), "t": np.datetime64("2026-03-09T06:30")},
    )
    assert json.loads(path.read_text()) == {"a": None, "b": [1.5, None], "t": "2026-03-09T06:30:00.000Z"}
    assert plain((np.int64(3), {"nat": np.datetime64("NaT")})) == [3, {"nat": None}]


def test_a_killed_write_leaves_the_old_product_and_no_rubbish(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    write_json(path, {"run": 1})

    def die_half_way(temporary: Path) -> None:
        temporary.write_text('{"run": 2')
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, die_half_way)
    assert json.loads(path.read_text()) == {"run": 1}
    assert [item.name for item in tmp_path.iterdir()] == ["results.json"]


def test_a_full_disk_is_told_with_the_remedy(tmp_path: Path) -> None:
    path = write_json(tmp_path / "results.json", {"run": 1})

    def fill(temporary: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match=r"results\.json: cannot be written \(No space left on device\); .* --resume"):
        write_atomically(path, fill)
    assert json.loads(path.read_text()) == {"run": 1}


def test_a_dataset_is_not_begun_where_the_disk_has_no_room_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = xr.Dataset({"rise": ("x", np.zeros(1_000_000))})
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=9_700_000))
    with pytest.raises(OutputError, match=r"x\.nc: may take 10 MB, and the disk has 10 MB left"):
        write_dataset(tmp_path / "x.nc", dataset)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=9_900_000))
    assert write_dataset(tmp_path / "x.nc", dataset).exists()


def test_datasets_come_back_equal(tmp_path: Path, rng: np.random.Generator) -> None:
    dataset = xr.Dataset(
        {
            "rise": (("cycle", "y", "x"), rng.normal(size=(3, 60, 70)).astype("f4"), {"units": "K"}),
            "time": ("cycle", np.array(["2026-03-09T06:30:05.250", "NaT", "2026-03-09T07:00"], "M8[ns]")),
            "name": ("fiducial", ["F1", "F2"]),
        },
        coords={"cycle": [1, 2, 3]},
        attrs={"title": "A"},
    )
    xr.testing.assert_identical(read_dataset(write_dataset(tmp_path / "x.nc", dataset)), dataset)


@pytest.mark.parametrize("read", [read_dataset, read_tree, open_dataset])
@pytest.mark.parametrize(
    "damage", [lambda whole: b"", lambda whole: whole[: len(whole) // 2], lambda whole: b"[" * 5_000]
)
def test_a_damaged_product_is_named(
    tmp_path: Path, read: Callable[[Path], object], damage: Callable[[bytes], bytes]
) -> None:
    path = write_dataset(tmp_path / "x.nc", xr.Dataset({"rise": ("x", np.arange(1_000.0))}))
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DamagedProductError, match=r"x\.nc: is damaged .*run the campaign again"):
        read(path)
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "absent.nc")


def test_a_stage_is_done_only_for_the_same_input_and_untouched_files(tmp_path: Path) -> None:
    product = tmp_path / "fields.nc"
    product.write_bytes(b"product")
    StageStamps(tmp_path).record("fields", "key", [product], {"rms_mm": 0.1})
    stamps = StageStamps(tmp_path)
    assert stamps.done("fields", "key")
    assert stamps.note("fields") == {"rms_mm": 0.1}
    assert not stamps.done("fields", "other key")
    assert not stamps.done("loop", "key")
    stamps.forget("fields")
    assert not StageStamps(tmp_path).done("fields", "key")
    stamps.record("fields", "key", [product], {})
    product.write_bytes(b"touched")
    assert not stamps.done("fields", "key")
    stamps.renew(product)
    assert StageStamps(tmp_path).done("fields", "key")
    StageStamps(tmp_path / "copied").renew(tmp_path / "copied" / product.name)
    assert not (tmp_path / "copied").exists()
    assert (finished_stages(tmp_path), finished_stages(tmp_path / "absent")) == (["fields"], [])


def test_the_digest_depends_on_content_alone() -> None:
    assert digest({"b": 1, "a": [1.5]}) == digest({"a": [np.float64(1.5)], "b": np.int64(1)}) != digest({"a": 2})


@pytest.mark.parametrize("stamp", [5, [], {}, {"key": "k"}, {"key": "k", "files": [], "note": {}}])
def test_a_damaged_stamp_is_none(tmp_path: Path, stamp: object) -> None:
    write_json(tmp_path / ".stages" / "stamps.json", {"fields": stamp})
    assert not StageStamps(tmp_path).done("fields", "k")
    assert finished_stages(tmp_path) == noted_messages(tmp_path) == []


def test_notices_of_finished_stages_are_told_while_a_run_is_under_way(tmp_path: Path) -> None:
    assert noted_messages(tmp_path) == []
    stamps = StageStamps(tmp_path)
    stamps.record("fields", "key", [], {"parts": {}, "notices": [{"code": "a", "message": "M.", "remedy": "R."}]})
    stamps.record("model", "key", [], None)
    assert noted_messages(tmp_path) == [{"code": "a", "message": "M.", "remedy": "R."}]


def test_what_is_no_json_object_holds_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "provenance.json"
    assert read_json_object(path) == {}
    for damaged in ("{", "null", "[1, 2]", "[" * 100_000, "\ud800".encode("utf-16", "surrogatepass").decode("latin-1")):
        path.write_text(damaged, encoding="latin-1")
        assert read_json_object(path) == {}
    path.unlink()
    os.mkfifo(path)
    assert read_json_object(path) == {}
    with pytest.raises(ValueError, match="a pipe, a socket or a device"):
        read_json(path)
    path.unlink()
    path.write_text('{"axis": "X"}', encoding="utf-8")
    assert read_json_object(path) == {"axis": "X"}
    path.write_text('{"a": [1e308, 0.1]}')
    with pytest.raises(ValueError, match=r"1e308 is no measured number"):
        read_json(path)
    path.write_text('{"a": [5e-324, -1e-9]}')
    assert read_json_object(path) == {"a": [0.0, -1e-9]}
    monkeypatch.setattr(store, "_MOST_JSON_BYTES", 10)
    assert read_json_object(path) == {}


def test_large_arrays_are_written_in_pieces_and_stay_in_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    monkeypatch.setattr(store, "IN_MEMORY_BYTES", 50_000)
    monkeypatch.setattr(store, "_CHUNK_BYTES", 9_000)
    monkeypatch.setattr("thermography.large_arrays.PIECE_BYTES", 20_000)
    rise = rng.normal(size=(100, 10, 20)).astype("f4")
    rise[3, 2] = np.nan
    whole = xr.Dataset(
        {"rise": (("cycle", "y", "x"), rise), "count": (("cycle", "y", "x"), (10 * rise[::1] > 3).astype("i4"))},
        {"cycle": np.arange(1, 101)},
    )
    path = write_dataset(tmp_path / "fields.nc", whole)
    opened = open_dataset(path)
    assert is_large(opened)
    # Nothing of it is read before it is asked for, and then no more than that.
    assert not opened["rise"].variable._in_memory and opened["cycle"].variable._in_memory
    assert (opened["rise"][-1].values == rise[-1]).all() and not opened["rise"].variable._in_memory
    assert np.concatenate([some for _, some in in_pieces(opened["rise"])]).tobytes() == rise.tobytes()
    xr.testing.assert_identical(read_dataset(path), whole)
    assert opened["rise"].encoding["chunksizes"] == (11, 10, 20)
    opened.close()


def test_nothing_of_a_tree_that_was_read_is_left_in_its_file(tmp_path: Path) -> None:
    """A file that is opened again for a variable stays open, and the library of HDF5 ends the process at the next look at it."""
    courses = {"rise": ("cycle", np.arange(3.0)), "comparison_chart": ("cycle", ["a", "b", "c"])}
    dataset = xr.Dataset({**courses, "chart_chart": ("cycle", np.ones(3)), "chart_limit": ((), 1.0)})
    tree = read_tree(write_dataset(tmp_path / "deviations.nc", in_groups(dataset)))
    for node in tree.subtree:
        for name, variable in node.to_dataset().variables.items():
            assert variable._in_memory, (node.path, name)
    xr.testing.assert_identical(
        joined(tree.to_dataset(), **{name: one.to_dataset() for name, one in tree.children.items()}), dataset
    )


def test_a_small_dataset_is_opened_into_memory(tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "fields.nc", xr.Dataset({"rise": ("cycle", np.arange(3.0))}))
    assert open_dataset(path)["rise"].variable._in_memory


@pytest.fixture
def large_fields(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> Path:
    """A product whose map stays in the file, stored in eleven parts."""
    monkeypatch.setattr(store, "IN_MEMORY_BYTES", 50_000)
    monkeypatch.setattr(store, "_CHUNK_BYTES", 80_000)
    rise = rng.normal(size=(1_000, 10, 20)).astype("f4")
    return write_dataset(tmp_path / "fields.nc", xr.Dataset({"rise": (("cycle", "y", "x"), rise)}))


def open_handles(path: Path) -> int:
    """How often this process has a file open."""
    return sum(link.resolve() == path for link in Path("/proc/self/fd").iterdir())


def damage(path: Path) -> None:
    """Overwrite some of the middle of a file."""
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 2 : len(whole) // 2 + 2_000] = bytes(2_000)
    path.write_bytes(whole)


def test_damage_that_is_met_when_some_cycles_are_read_names_the_file(large_fields: Path) -> None:
    damage(large_fields)
    opened = open_dataset(large_fields)
    assert opened["rise"][0].values.shape == (10, 20)
    for read in (lambda: opened["rise"].values, lambda: list(in_pieces(opened["rise"])), opened.copy().load):
        with pytest.raises(DamagedProductError, match=r"fields\.nc: is damaged .*\(OSError\)"):
            read()
    opened.close()


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="open files are counted in /proc")
def test_a_file_is_closed_with_its_dataset_and_where_opening_fails(
    large_fields: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = open_dataset(large_fields)
    assert open_handles(large_fields) == 1
    opened.close()
    assert open_handles(large_fields) == 0
    # The damaged map is small enough to be read at once.
    damage(large_fields)
    monkeypatch.setattr(store, "IN_MEMORY_BYTES", 1_000_000)
    with pytest.raises(DamagedProductError) as told:
        open_dataset(large_fields)
    assert told.tb is not None, "the stack still holds what was opened"
    assert open_handles(large_fields) == 0


def test_an_open_product_stays_the_file_that_was_opened(large_fields: Path, tmp_path: Path) -> None:
    opened = open_dataset(large_fields)
    rise = read_dataset(large_fields)["rise"].values
    write_dataset(large_fields, xr.Dataset({"rise": (("cycle", "y", "x"), np.zeros_like(rise))}))
    other = write_dataset(tmp_path / "other.nc", xr.Dataset({"rise": ("x", np.arange(3.0))}))
    # The next file takes the place of the first one in the cache of xarray.
    with xr.set_options(file_cache_maxsize=1), xr.open_dataset(other, engine="h5netcdf"):
        assert (opened["rise"].values == rise).all()
    opened.close()


def test_an_open_product_can_be_sent_to_another_process(large_fields: Path) -> None:
    opened = open_dataset(large_fields)
    sent = pickle.loads(pickle.dumps(opened))
    assert not sent["rise"].variable._in_memory
    xr.testing.assert_identical(sent, opened)
    opened.close()
    assert sent["rise"][-1].values.shape == (10, 20)


# The contract of a Dataset: kept, or every broken promise in one message.


OVER_TIME = {name: (("time", "sensor"), np.zeros((2, 1))) for name in ("temperature", "rise")}
SENSORS = xr.Dataset({**OVER_TIME, **{name: ("sensor", [0.0]) for name in ("x", "y", "is_faulty", "fault")}})


def test_a_broken_contract_is_told_whole() -> None:
    contract = {"rise": (("y", "x"), "K", "f"), "time": (("cycle",), "", "M"), "count": (("y", "x"), "1", "i")}
    rise, count = np.zeros((2, 3)), np.zeros((3, 2))
    wrong = {"rise": (("x", "y"), rise, {"units": "degC"}), "count": (("y", "x"), count, {"units": "1"})}
    with pytest.raises(ContractError) as error:
        check(xr.Dataset(wrong), contract, name="the fields")
    assert str(error.value).removeprefix("the fields breaks its contract: ").split("; ") == [
        "rise has dims (x, y), not (y, x)",
        "rise is in 'degC', not 'K'",
        "time is missing",
        "count is of type float64, not of kind 'i'",
    ]
    good = xr.Dataset({"rise": (("y", "x"), rise, {"units": "K"})})
    assert check(good, {"rise": contract["rise"]}, name="the fields") is good


def test_a_netcdf_of_another_kind_under_the_name_of_a_product_is_told(tmp_path: Path) -> None:
    write_dataset(tmp_path / "sensors.nc", SENSORS)
    assert read_product(tmp_path, "sensors").identical(SENSORS)
    for name in ("fields", "deviations", "fusion"):
        write_dataset(tmp_path / f"{name}.nc", SENSORS)
        with pytest.raises(DamagedProductError, match=rf"{name}\.nc: is another kind of file: .* not in it"):
            read_fusion(tmp_path) if name == "fusion" else read_product(tmp_path, name)
    write_dataset(tmp_path / "sensors.nc", SENSORS.transpose("sensor", "time"))
    with pytest.raises(DamagedProductError, match=r"temperature \(time, sensor\), rise \(time, sensor\) not in it"):
        read_product(tmp_path, "sensors")


def test_a_product_of_another_run_is_told_by_its_hash(tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "sensors.nc", SENSORS)
    listed = {"sensors.nc": {"bytes": path.stat().st_size, "sha256": file_sha256(path)}}
    write_json(tmp_path / "provenance.json", {"products": listed})
    require_own(tmp_path, ["sensors.nc", "absent.nc"])
    write_dataset(path, SENSORS + 1.0)
    with pytest.raises(DamagedProductError, match=r"sensors\.nc: is not the file that this run wrote"):
        read_product(tmp_path, "sensors")
    path.unlink()
    for read in (read_product, lambda folder, name: has_product(folder, f"{name}.nc")):
        with pytest.raises(
            DamagedProductError, match=r"sensors\.nc is missing; put the file back, or run the campaign"
        ):
            read(tmp_path, "sensors")
    assert not has_product(tmp_path, "absent.nc")
    for damaged in ({"products": {"sensors.nc": {}}}, {"products": 1}, {"parameters": {"campaign": 5}}, []):
        write_json(tmp_path / "provenance.json", damaged)
        with pytest.raises(
            DamagedProductError, match=r"provenance\.json: not the provenance of a run; run the campaign"
        ):
            require_own(tmp_path, ["sensors.nc"])
    write_json(tmp_path / "provenance.json", {})
    require_own(tmp_path, ["sensors.nc"])


def test_fields_of_another_kind_are_not_left_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.results.store.IN_MEMORY_BYTES", 1_000)
    path = write_dataset(tmp_path / "fields.nc", xr.Dataset({"rise": ("x", np.zeros(1_000))}))
    with pytest.raises(DamagedProductError, match="another kind of file") as told:
        read_product(tmp_path, "fields")
    assert told.tb is not None, "the stack still holds what was opened"
    # A file that is open for reading cannot be opened for writing.
    with h5py.File(path, "r+"):
        pass


# Several results in one product: prefixes in a flat Dataset, groups in a NetCDF file.


READINGS = xr.Dataset({"deviation": ("target", [0.1, 0.2])}, {"target": [1, 2]})
DRIFT = xr.Dataset({"profile": ("target", [1.0, 2.0])}, {"target": [1, 2]})


def test_a_part_comes_back_under_its_own_names() -> None:
    product = joined(READINGS, estimate=DRIFT)
    assert set(product.data_vars) == {"deviation", "estimate_profile"}
    xr.testing.assert_equal(group(product, "estimate"), DRIFT)
    assert has(product, "estimate") and not has(product, "iso")


def test_every_group_opens_by_itself_with_its_coordinates(tmp_path: Path) -> None:
    maps = xr.Dataset(
        {"p_value": (("channel", "x"), np.ones((2, 3)))}, {"channel": ["common", "joint"], "x": [5.0, 15.0, 25.0]}
    )
    modes = xr.Dataset({"lag": (("channel", "mode"), np.zeros((2, 1)))}, {"mode": [1]})
    correlation = xr.DataTree(maps, children={"modes": xr.DataTree(modes)})
    tree = annotate(
        xr.DataTree(READINGS, children={"correlation": correlation}), title="x", history="y", provenance="{}"
    )
    path = write_dataset(tmp_path / "fusion.nc", tree)
    with xr.open_dataset(path, engine="h5netcdf") as root:
        xr.testing.assert_equal(root, READINGS)
        assert root["deviation"].attrs["long_name"] == "deviation"
        assert root.attrs["title"] == "x"
    with xr.open_dataset(path, group="correlation", engine="h5netcdf") as plan:
        xr.testing.assert_equal(plan, maps)
    with xr.open_dataset(path, group="correlation/modes", engine="h5netcdf") as opened:
        assert list(opened["lag"].sel(mode=1)["channel"].values) == ["common", "joint"]
        assert set(opened.coords) == {"channel", "mode"}
    xr.testing.assert_identical(read_tree(path), tree)
    assert READINGS["deviation"].attrs == {}


def test_values_by_place_and_approach_are_those_of_their_labels() -> None:
    values = xr.DataArray(
        [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
        dims=("direction", "target"),
        coords={"direction": ["negative", "positive"], "target": [1, 2, 7]},
    )
    np.testing.assert_array_equal(by_approach(values, target=np.array([7, 1])), [[6.0, 3.0], [4.0, 1.0]])


def test_variables_keep_names_that_netcdf_cannot_store(tmp_path: Path) -> None:
    names = [
        "=1+1", " a", "a ", "a b", "a_b", "🌡", "{0}", "<b>", "#", "@x", "%41", '"q"', "\\", "a.b", "-1", ".", "a\tb", "1", "_",
        "L" * 300, "L" * 299 + "x", "\u00e9", "e\u0301", "\u03a9", "\u2126",
    ]  # fmt: skip
    series = {name: ("time", np.arange(3.0) + at, {"units": "1"}) for at, name in enumerate(names)}
    written = xr.Dataset(series, {"time": [0, 1, 2]})
    tree = xr.DataTree(written, children={"part": xr.DataTree(xr.Dataset({"z": ("time", np.zeros(3))}))})
    xr.testing.assert_identical(read_dataset(write_dataset(tmp_path / "a.nc", written)), written)
    read = read_tree(write_dataset(tmp_path / "b.nc", tree))
    xr.testing.assert_identical(read.to_dataset(), written)
    assert list(read.children) == ["part"]
