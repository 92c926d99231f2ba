"""Hostile NetCDF and Zarr stores as frames: each is written whole by its library, or by hand where no library would write it."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numcodecs
import numpy as np
import xarray as xr
from scipy.io import netcdf_file

SHAPE = (3, 4, 5)
#: The value of a file beside the stores that none of them may show, degC.
SECRET = 77.25
Write = Callable[[Path], None]
_HUGE = (1_000_000, 1_000, 1_000)


def stack() -> xr.Dataset:
    """Frames as any program writes them."""
    values = np.full(SHAPE, 21.5, "f4")
    time = np.datetime64("2026-03-09T06:30", "ns") + np.arange(SHAPE[0]) * np.timedelta64(1, "s")
    return xr.DataArray(
        values, dims=("time", "y", "x"), coords={"time": time}, attrs={"units": "degC"}, name="temperature"
    ).to_dataset()


def write_secret(path: Path) -> None:
    """Write a file of which every way of reading shows the secret: as HDF5, as bytes behind it, as a chunk."""
    with h5py.File(path, "w") as file:
        file["x"] = np.full(SHAPE, SECRET, "f4")
    with path.open("ab") as file:
        file.write(np.full(100_000, SECRET, "f4").tobytes())


def hdf5(change: Callable[[h5py.File], object], path: Path) -> None:
    stack().to_netcdf(path, engine="h5netcdf")
    with h5py.File(path, "r+") as file:
        change(file)


def replaced(name: str, **options: Any) -> Callable[[h5py.File], object]:
    """Put another dataset in the place of one."""

    def change(file: h5py.File) -> None:
        if name in file:
            del file[name]
        file.create_dataset(name, **options)
        file[name].attrs["units"] = "degC"

    return change


def attribute(variable: str, name: str, value: Any) -> Callable[[h5py.File], object]:
    def change(file: h5py.File) -> None:
        file[variable].attrs[name] = file.ref if isinstance(value, str) and value == "REF" else value

    return change


def _attributes() -> Iterator[tuple[str, Write]]:
    values = {
        "text": "x",
        "long text": "x" * 60_000,
        "array": np.arange(3.0),
        "nothing": h5py.Empty("f4"),
        "no number": np.nan,
        "infinite": np.inf,
        "bytes": np.void(b"\xff\xfe\x00\x01"),
        "reference": "REF",
        "whole": np.int64(2**62),
        "compound": np.zeros(1, [("a", "f4"), ("b", "S3")]),
    }
    for name in (
        "_FillValue",
        "missing_value",
        "scale_factor",
        "add_offset",
        "units",
        "coordinates",
        "_Unsigned",
        "dtype",
    ):
        for kind, value in values.items():
            yield f"{name} is {kind}", partial(hdf5, attribute("temperature", name, value))
    for name in ("units", "calendar", "bounds", "_FillValue", "scale_factor"):
        for kind, value in values.items():
            yield f"time {name} is {kind}", partial(hdf5, attribute("time", name, value))
    for name in ("DIMENSION_LIST", "CLASS", "NAME", "_Netcdf4Dimid", "_Netcdf4Coordinates"):
        for kind in ("text", "array", "reference", "whole", "compound"):
            yield f"{name} is {kind}", partial(hdf5, attribute("temperature", name, values[kind]))


def _times() -> Iterator[tuple[str, Write]]:
    texts = (
        "days since 99999999-01-01",
        "fortnights since 1970-01-01",
        "seconds since",
        "days since 1970-01-01T99:99",
        "s\0",
    )
    for text in (*texts, "seconds since 1970-01-01" + " " * 50_000):
        yield f"times in {text[:30]!r}", partial(hdf5, attribute("time", "units", text))
    for calendar in ("360_day", "none", "julian", "x" * 50_000):
        yield f"calendar {calendar[:10]}", partial(hdf5, attribute("time", "calendar", calendar))
    kinds: dict[str, Any] = {
        "1e300": np.full(3, 1e300),
        "not numbers": np.full(3, np.nan),
        "infinite": np.full(3, np.inf),
        "largest": np.full(3, 2**63 - 1, "i8"),
        "texts": np.array([b"a", b"b", b"c"]),
        "compound": np.zeros(3, [("a", "f4")]),
        "a table": np.zeros((3, 3)),
        "too many": np.zeros(1_000_000),
    }
    for kind, data in kinds.items():

        def change(file: h5py.File, data: Any = data) -> None:
            units = file["time"].attrs["units"]
            replaced("time", data=data)(file)
            file["time"].attrs["units"] = units
            file["time"].make_scale("time")
            file["temperature"].dims[0].attach_scale(file["time"])

        yield f"times are {kind}", partial(hdf5, change)


def _types() -> Iterator[tuple[str, Write]]:
    kinds: dict[str, Any] = {
        "compound": [("a", "f4"), ("b", "f4")],
        "opaque": np.dtype("V16"),
        "reference": h5py.ref_dtype,
        "region": h5py.regionref_dtype,
        "texts": h5py.string_dtype(),
        "fixed text": np.dtype("S5"),
        "lists": h5py.vlen_dtype("f4"),
        "enumeration": h5py.enum_dtype({"a": 0, "b": 1}, "i2"),
        "truth": np.dtype(bool),
        "complex": np.dtype("c16"),
        "half": np.dtype("f2"),
        "other order": np.dtype(">f8"),
        "arrays": np.dtype(("f4", (3,))),
        "long": np.dtype("g"),
        "unsigned": np.dtype("u8"),
    }
    for kind, dtype in kinds.items():
        yield f"values are {kind}", partial(hdf5, replaced("temperature", shape=SHAPE, dtype=dtype))


def _sizes() -> Iterator[tuple[str, Write]]:
    for shape in ((0, 4, 5), (3, 0, 5), (3, 4, 0), (0, 0, 0), (1, 1, 1), (1_000_000, 1, 1), (2_000_000, 1, 1)):
        yield (
            f"shape {shape}",
            partial(hdf5, replaced("temperature", shape=shape, dtype="f4", chunks=True if 0 not in shape else None)),
        )
    yield "1e12 values in one piece", partial(hdf5, replaced("temperature", shape=_HUGE, dtype="f4"))
    yield (
        "1e12 values in chunks",
        partial(hdf5, replaced("temperature", shape=_HUGE, dtype="f4", chunks=(1, 1000, 1000))),
    )
    yield (
        "one chunk of 4 GB",
        partial(hdf5, replaced("temperature", shape=(1, 32_000, 32_000), dtype="f4", chunks=(1, 32_000, 32_000))),
    )
    yield "1e9 other values", partial(hdf5, replaced("other", shape=(1_000_000_000,), dtype="f8", chunks=(1_000_000,)))
    yield "two stacks", partial(hdf5, replaced("other", data=np.zeros(SHAPE)))

    def inflating(file: h5py.File) -> None:
        replaced("temperature", shape=(200, 1000, 1000), dtype="f4", chunks=(200, 1000, 1000), compression="gzip")(file)
        file["temperature"].id.write_direct_chunk((0, 0, 0), zlib.compress(bytes(800_000_000), 9))

    yield "a chunk that inflates to 0.8 GB", partial(hdf5, inflating)
    yield "a chunk that does not inflate", partial(hdf5, partial(_spoilt_chunk, b"x" * 80))
    yield "a chunk of too few bytes", partial(hdf5, partial(_spoilt_chunk, zlib.compress(b"1234")))
    yield "2,000 variables", partial(hdf5, lambda file: [file.create_dataset(f"v{n}", data=n) for n in range(2_000)])
    yield "2,000 groups", partial(hdf5, lambda file: [file.create_group(f"g{n}") for n in range(2_000)])
    yield "300 groups within groups", partial(hdf5, lambda file: file.create_group("/".join("g" * 300)))
    yield "stack in a group alone", partial(hdf5, lambda file: file.move("temperature", "group/temperature"))
    yield "nothing", partial(hdf5, lambda file: [file.pop(name) for name in list(file)])


def _spoilt_chunk(content: bytes, file: h5py.File) -> None:
    replaced("temperature", shape=SHAPE, dtype="f4", chunks=SHAPE, compression="gzip")(file)
    file["temperature"].id.write_direct_chunk((0, 0, 0), content)


def _links(secret: Path) -> Iterator[tuple[str, Write]]:
    outside = str(secret)

    def storage(file: h5py.File) -> None:
        replaced("temperature", shape=SHAPE, dtype="f4", external=[(outside, secret.stat().st_size - 400_000, 240)])(
            file
        )

    def virtual(source: str, name: str, file: h5py.File) -> None:
        layout = h5py.VirtualLayout(SHAPE, "f4")
        layout[...] = h5py.VirtualSource(source, name, SHAPE)
        del file["temperature"]
        file.create_virtual_dataset("temperature", layout)
        file["temperature"].attrs["units"] = "degC"

    def linked(name: str, link: Any, file: h5py.File) -> None:
        if name in file:
            del file[name]
        file[name] = link

    def to_itself(file: h5py.File) -> None:
        file["group/again"] = file["/"]
        file["group/soft"] = h5py.SoftLink("/group/again/group")

    yield "external storage", partial(hdf5, storage)
    yield "virtual from outside", partial(hdf5, partial(virtual, outside, "x"))
    yield "virtual from a pattern", partial(hdf5, partial(virtual, outside.replace("secret", "secre%b"), "x"))
    yield "virtual from itself", partial(hdf5, partial(virtual, ".", "temperature"))
    for name in ("temperature", "time", "group/deep"):
        yield f"{name} linked to outside", partial(hdf5, partial(linked, name, h5py.ExternalLink(outside, "/x")))
        yield f"{name} linked to nothing", partial(hdf5, partial(linked, name, h5py.SoftLink("/nowhere")))
        yield f"{name} linked to itself", partial(hdf5, partial(linked, name, h5py.SoftLink(f"/{name}")))
    yield "groups in a circle", partial(hdf5, to_itself)


def _bytes_of_hdf5() -> Iterator[tuple[str, Write]]:
    def spoilt(change: Callable[[bytes], bytes], path: Path) -> None:
        stack().to_netcdf(path, engine="h5netcdf")
        path.write_bytes(change(path.read_bytes()))

    yield "first 100 bytes", partial(spoilt, lambda content: content[:100])
    yield "first half", partial(spoilt, lambda content: content[: len(content) // 2])
    yield "last byte missing", partial(spoilt, lambda content: content[:-1])
    yield "signature alone", partial(spoilt, lambda content: content[:8])
    yield "another version", partial(spoilt, lambda content: content[:8] + b"\x09" + content[9:])
    yield "end far away", partial(spoilt, lambda content: content[:28] + b"\xff" * 8 + content[36:])
    yield "behind a block of another", partial(spoilt, lambda content: bytes(512) + content)


def _classic() -> Iterator[tuple[str, Write]]:
    """NetCDF 3: no reader of frames takes it, and each is told so."""

    def written(change: Callable[[bytes], bytes], path: Path, version: int = 1) -> None:
        with netcdf_file(path, "w", version=version) as file:
            for name, size in zip(("time", "y", "x"), SHAPE, strict=True):
                file.createDimension(name, size)
            file.createVariable("temperature", "f4", ("time", "y", "x"))[:] = 20.0
        path.write_bytes(change(path.read_bytes()))

    yield "classic", partial(written, lambda content: content)
    yield "classic of 64 bits", partial(written, lambda content: content, version=2)
    yield "classic of version 5", partial(written, lambda content: b"CDF\x05" + content[4:])
    yield "classic, records without end", partial(written, lambda content: content[:4] + b"\xff" * 4 + content[8:])
    yield (
        "classic, length of a dimension",
        partial(written, lambda content: content.replace(struct.pack(">I", 5), b"\x7f\xff\xff\xff")),
    )
    yield "classic, cut", partial(written, lambda content: content[:40])


def zarr_store(version: int, change: Callable[[Path], object], path: Path) -> None:
    stack().to_zarr(path, consolidated=False, zarr_format=version)  # type: ignore[call-overload]
    change(path)


def metadata(file: str, **keys: Any) -> Callable[[Path], object]:
    """Change keys of a file of a store; None takes a key out."""

    def change(path: Path) -> None:
        content = json.loads((path / file).read_text())
        for key, value in keys.items():
            content[key] = value
        (path / file).write_text(json.dumps(content))

    return change


def _zarr_of_both() -> Iterator[tuple[str, Write]]:
    common: dict[str, Any] = {
        "shape of 1e12": {"shape": list(_HUGE)},
        "shape of 0": {"shape": [0, 4, 5]},
        "shape below 0": {"shape": [-3, 4, 5]},
        "shape of fractions": {"shape": [3.5, 4, 5]},
        "shape of texts": {"shape": ["3", "4", "5"]},
        "shape is a number": {"shape": 3},
        "shape of 40 dimensions": {"shape": [1] * 40},
        "shape beyond 64 bits": {"shape": [2**70, 4, 5]},
        "no shape": {"shape": None},
        "fill value is text": {"fill_value": "x" * 1_000},
        "fill value is a list": {"fill_value": [1, 2]},
        "fill value is an object": {"fill_value": {"a": 1}},
        "fill value is infinite": {"fill_value": "Infinity"},
        "format 9": {"zarr_format": 9},
        "format is text": {"zarr_format": "2"},
        "attributes are a list": {"attributes": [1]},
    }
    for version, file in ((2, "temperature/.zarray"), (3, "temperature/zarr.json")):
        for kind, keys in common.items():
            yield f"zarr {version}: {kind}", partial(zarr_store, version, metadata(file, **keys))
        texts = {
            "no JSON": "{",
            "brackets": "[" * 100_000,
            "a list": "[]",
            "nothing": "",
            "5 MB number": '{"shape": ' + "1" * 5_000_000 + "}",
        }
        for kind, text in texts.items():

            def put(path: Path, file: str = file, text: str = text) -> None:
                (path / file).write_text(text)

            yield f"zarr {version}: metadata are {kind}", partial(zarr_store, version, put)
        chunk = "temperature/0.0.0" if version == 2 else "temperature/c/0/0/0"

        def chunk_of(content: bytes, path: Path, chunk: str = chunk) -> None:
            (path / chunk).write_bytes(content)

        def in_place_of_chunk(make: Callable[[Path], object], path: Path, chunk: str = chunk) -> None:
            (path / chunk).unlink()
            make(path / chunk)

        yield f"zarr {version}: a chunk of rubbish", partial(zarr_store, version, partial(chunk_of, b"rubbish" * 9))
        yield f"zarr {version}: an empty chunk", partial(zarr_store, version, partial(chunk_of, b""))
        inflating = (
            numcodecs.Blosc("zstd").encode(bytes(1_500_000_000))
            if version == 2
            else numcodecs.Zstd().encode(bytes(1_500_000_000))
        )
        yield (
            f"zarr {version}: a chunk that inflates to 1.5 GB",
            partial(zarr_store, version, partial(chunk_of, inflating)),
        )
        yield (
            f"zarr {version}: a folder as a chunk",
            partial(zarr_store, version, partial(in_place_of_chunk, Path.mkdir)),
        )
        yield (
            f"zarr {version}: a chunk that links to itself",
            partial(zarr_store, version, partial(in_place_of_chunk, lambda at: at.symlink_to(at.name))),
        )
        yield (
            f"zarr {version}: a group that links to itself",
            partial(zarr_store, version, lambda path: (path / "again").symlink_to(path, target_is_directory=True)),
        )


def _zarr_of_one() -> Iterator[tuple[str, Write]]:
    second = {
        "chunks of 0": {"chunks": [0, 0, 0]},
        "chunks beyond memory": {"shape": [1 << 20, 1 << 12, 1 << 12], "chunks": [1 << 20, 1 << 12, 1 << 12]},
        "too few chunks": {"chunks": [3]},
        "objects": {"dtype": "|O"},
        "opaque": {"dtype": "|V8"},
        "wide texts": {"dtype": "<U100000"},
        "a structure": {"dtype": [["a", "<f4"]]},
        "dates": {"dtype": "<M8[ns]"},
        "no type": {"dtype": "nonsense"},
        "unknown compressor": {"compressor": {"id": "nobody"}},
        "pickle": {"dtype": "|O", "filters": [{"id": "pickle"}]},
        "unknown filter": {"filters": [{"id": "nobody"}]},
        "order Q": {"order": "Q"},
        "separator": {"dimension_separator": "/../../"},
    }
    for kind, keys in second.items():
        yield f"zarr 2: {kind}", partial(zarr_store, 2, metadata("temperature/.zarray", **keys))
    dimensions = {
        "numbers": [1, 2, 3],
        "two": ["time", "y"],
        "text": "time",
        "the same": ["y", "y", "y"],
        "an object": {"a": 1},
        "empty": ["", "", ""],
    }
    for kind, names in dimensions.items():
        yield (
            f"zarr 2: dimensions are {kind}",
            partial(zarr_store, 2, metadata("temperature/.zattrs", _ARRAY_DIMENSIONS=names)),
        )
        yield (
            f"zarr 3: dimensions are {kind}",
            partial(zarr_store, 3, metadata("temperature/zarr.json", dimension_names=names)),
        )
    third = {
        "unknown type": {"data_type": "nonsense"},
        "raw bits": {"data_type": "r64"},
        "type is an object": {
            "data_type": {"name": "numpy.datetime64", "configuration": {"unit": "x", "scale_factor": -1}}
        },
        "no codecs": {"codecs": []},
        "unknown codec": {"codecs": [{"name": "nobody", "configuration": {}}]},
        "codec twice": {"codecs": [{"name": "bytes"}] * 3},
        "grid of 0": {"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [0, 0, 0]}}},
        "another grid": {"chunk_grid": {"name": "nobody"}},
        "chunks beyond memory": {
            "shape": [1 << 20, 1 << 12, 1 << 12],
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [1 << 20, 1 << 12, 1 << 12]}},
        },
        "separator": {"chunk_key_encoding": {"name": "default", "configuration": {"separator": "/../../"}}},
        "transformers": {"storage_transformers": [{"name": "nobody"}]},
        "a group": {"node_type": "group"},
        "must be understood": {"nobody": {"must_understand": True}},
    }
    for kind, keys in third.items():
        yield f"zarr 3: {kind}", partial(zarr_store, 3, metadata("temperature/zarr.json", **keys))
    yield "zarr 3: root is an array", partial(zarr_store, 3, metadata("zarr.json", node_type="array"))
    yield (
        "zarr 3: root has members",
        partial(
            zarr_store,
            3,
            metadata("zarr.json", consolidated_metadata={"kind": "inline", "metadata": {"../../secret": {}}}),
        ),
    )
    yield "zarr 2: attributes of times", partial(zarr_store, 2, metadata("time/.zattrs", units=5, calendar=[1]))
    yield (
        "zarr 2: attributes of values",
        partial(zarr_store, 2, metadata("temperature/.zattrs", units=["degC"], scale_factor="x", _FillValue={})),
    )
    yield "zarr 2: 1,200 arrays", partial(zarr_store, 2, partial(_copies, 1_200))


def _copies(count: int, path: Path) -> None:
    for number in range(count):
        (path / f"v{number}").mkdir()
        for name in (".zarray", ".zattrs"):
            (path / f"v{number}" / name).write_bytes((path / "time" / name).read_bytes())


def hostile_stores(secret: Path) -> Iterator[tuple[str, Write]]:
    """Yield a name for every store, and what writes it to a path.

    Parameters
    ----------
    secret : Path
        A file outside the folder of the stores, of `write_secret`.
    """
    yield "sound", partial(hdf5, lambda file: None)
    yield from _attributes()
    yield from _times()
    yield from _types()
    yield from _sizes()
    yield from _links(secret)
    yield from _bytes_of_hdf5()
    yield from _classic()
    yield "zarr 2: sound", partial(zarr_store, 2, lambda path: None)
    yield "zarr 3: sound", partial(zarr_store, 3, lambda path: None)
    yield from _zarr_of_both()
    yield from _zarr_of_one()
