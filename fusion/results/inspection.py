"""Products of a run as `thermofuse inspect` names and describes them: NetCDF, maps as OpenEXR, results and provenance as JSON."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from fusion.results.numbers import span
from fusion.results.store import GLOBAL_ATTRIBUTES, PRODUCTS, read_json_object

_EXR, _HDF5 = b"\x76\x2f\x31\x01", b"\x89HDF\r\n\x1a\n"
#: Texts of a run by their name, and how they are described.
_TEXTS = {
    "report.html": "page of a run, for a browser",
    "results.json": "results of a run: thermofuse report FOLDER writes its page",
    "provenance.json": "provenance of a run: inputs, products and their SHA-256",
    "manifest.json": "list of the files of a run",
}


def is_product(path: Path) -> bool:
    """Return whether a file is an OpenEXR map or what a run has written."""
    with path.open("rb") as file:
        start = file.read(8)
    if start == _HDF5:
        import h5py

        with h5py.File(path) as file:
            return "thermofuse run" in str(file.attrs.get("history", ""))
    return start.startswith(_EXR) or (path.name in _TEXTS and start.lstrip().startswith((b"{", b"<")))


def describe_product(path: Path) -> list[str]:
    """Return what a product holds: size, times, and the range of every quantity with its unit."""
    if path.name in _TEXTS:
        title = "" if path.suffix == ".html" else read_json_object(path).get("campaign", "")
        return [f"{_TEXTS[path.name]}{f'; campaign {title}' if title else ''}"]
    if path.suffix == ".nc":
        return list(_describe_dataset(path))
    return list(_describe_maps(path))


def _describe_dataset(path: Path) -> Iterator[str]:
    import xarray as xr

    with xr.open_dataset(path, engine="netcdf4", decode_timedelta=False) as product:
        sizes = ", ".join(f"{name} {size}" for name, size in product.sizes.items())
        yield f"product of a run, {product.attrs[GLOBAL_ATTRIBUTES[1]]}: {sizes}"
        for name in next((kind for stem, kind in PRODUCTS.items() if stem == path.stem), product.data_vars):
            if name in product.variables and product[name].size and product[name].dtype.kind in "fM":
                yield f"{name} {span(product[name].values, product[name].attrs.get('units', ''), '.4g')}"
        if path.stem == "fields":
            yield "thermofuse export RESULTS --format png, gif or mp4 draws every cycle"


def _describe_maps(path: Path) -> Iterator[str]:
    from thermography.io.files import read_header, read_maps

    maps, header = read_maps(path), read_header(path)
    rows, columns = next(iter(maps.values())).shape
    known = [f"{name.replace('_', ' ')} {header[name]}" for name in ("cycle", "time", "cell_size_mm") if name in header]
    yield f"OpenEXR maps of {columns} x {rows} cells: {', '.join(known) or 'no word of a run in the header'}"
    yield from (
        f"{name} {span(values, str(header.get(name, '')), '.4g')}" for name, values in maps.items() if name != "mask"
    )
