"""Every kind of file that a user gives to the program: small intact files, how they are damaged, and how they are read."""

from __future__ import annotations

import io
import json
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import tifffile
import xarray as xr

from fusion.analysis.attribution.modes import read_regions
from fusion.campaign.config import load_campaign
from fusion.campaign.inputs import read_record
from fusion.campaign.logs import read_drivers
from fusion.pipeline.compare import compare_campaigns
from fusion.pipeline.reproduce import reproduce
from fusion.pipeline.run import run_campaign
from fusion.report.exports.export import export_results
from fusion.report.findings import summary_rows
from fusion.report.page import report_of
from fusion.results.results import read_results
from fusion.twin.recipe_file import read_recipe
from interferometry.io.readings import is_environment_log, read_deviations, read_environment
from tests.interferometry import laser_mutations as laser
from tests.interferometry import old_workbooks as xls
from tests.soak.fuzz.harness import Kind
from tests.thermography import flir_mutations as flir
from thermography.common import ThermographyError
from thermography.inspection import inspect_file
from thermography.io.other_cameras import StackOptions, index_recordings
from thermography.registration.plan import read_fiducials
from thermography.registration.projection import read_lens

CAMPAIGN = """\
[campaign]
title = "X axis"
axis = "X"
[interferometry]
deviations = "long.csv"
dead_path = "0 mm"
expansion_coefficient = "11.7 ppm/K"
[drivers]
file = "drivers.csv"
[plan]
size = ["700 mm", "180 mm"]
[plan.axis]
origin = ["500 mm", "90 mm"]
direction = [-1, 0]
[model]
declared = ["material_compensation"]
"""
RECORD = """\
[campaign]
title = "R"
axis = "X"
[record]
file = "record.csv"
time = "time [s]"
temperatures = ["bearing [degC]"]
displacements = ["x [um]"]
[model]
declared = []
"""
DRIVERS = "time,duty [1],bearing [degC]\n" + "".join(f"2026-03-09T06:{m:02d}:00Z,0.{m},2{m}.5\n" for m in range(9))
TABLE = "time [s],bearing [degC],x [um]\n" + "".join(f"{60 * m},2{m % 10}.5,0.{m}\n" for m in range(12))
FIDUCIALS = "name,x_mm,y_mm,diameter_mm,column_px,row_px\n" + "".join(
    f"F{i},{50 * i},20,16,{10 * i},33\n" for i in range(6)
)
REGIONS = "name,x_mm,y_mm\n" + "".join(f"a,{x},{y}\n" for x, y in ((0, 0), (100, 0), (100, 80), (0, 80)))
LENS = (
    "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    "   data: [ 1530., 0., 320., 0., 1530., 240., 0., 0., 1. ]\ndistortion_coefficients: [ 0.1, 0., 0., 0., 0. ]\n"
)
RECIPE = Path("data/recipes/demo.toml").read_text(encoding="utf-8")
STACK = StackOptions(
    unit="degC", scale=0.04, offset=-273.15, start=np.datetime64("2026-03-09T06:30", "ns"), interval_s=1.0
)
_PIECES = tuple(piece for piece in laser.PIECES if len(piece) < 100)


def damaged_text(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage text as `laser_mutations` does, or exchange two of its words or numbers."""
    if rng.random() < 0.4:
        words = data.replace(b"=", b" = ").split(b" ")
        a, b = rng.integers(len(words), size=2)
        words[a], words[b] = words[b], _PIECES[int(rng.integers(len(_PIECES)))] if rng.random() < 0.5 else words[a]
        return b" ".join(words)
    return laser._mutated(data, rng)


def damaged_json(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage JSON as text, or replace a value, or drop or exchange keys, so that it remains JSON."""
    if rng.random() < 0.3:
        return damaged_text(data, rng)
    content = json.loads(data)
    for _ in range(int(rng.integers(1, 4))):
        level = content
        while isinstance(level, dict | list) and level:
            keys = list(level) if isinstance(level, dict) else list(range(len(level)))
            key = keys[int(rng.integers(len(keys)))]
            if not isinstance(level[key], dict | list) or not level[key] or rng.random() < 0.15:
                odd = [None, "", "<script>", -1, 1e308, [], {}, True, "x" * 500, [[]], 0, {"value": None}]
                level[key] = odd[int(rng.integers(len(odd)))]
                if isinstance(level, dict) and rng.random() < 0.2:
                    del level[key]
                break
            level = level[key]
    return json.dumps(content).encode()


def damaged_archive(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage an archive as bytes, or one of its parts so that the archive remains whole."""
    return flir.mutate(data, rng) if rng.random() < 0.5 else damaged_part(data, rng)


def damaged_compound(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage an old spreadsheet as a file, or the records of its workbook in a whole container."""
    if rng.random() < 0.5:
        return flir.mutate(data, rng)
    return xls.compound_file("Workbook", flir.mutate(data[xls.SECTOR :], rng))


def old_workbook() -> bytes:
    """Return a table of readings as a spreadsheet of Excel 97, dates as text."""
    rows = [line.split(",") for line in laser.LONG.strip().splitlines()]
    words = sorted({cell for row in rows for cell in row})
    cells = [
        xls.shared(at, column, words.index(cell)) for at, row in enumerate(rows) for column, cell in enumerate(row)
    ]
    table = xls.sheet(xls.size(len(rows), len(rows[0])), *cells)
    return xls.file_of(table, xls.sheet(*xls.TABLE), texts=xls.shared_texts(*words))


def damaged_part(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage one file of an archive."""
    source, target = zipfile.ZipFile(io.BytesIO(data)), io.BytesIO()
    names = source.namelist()
    chosen = names[int(rng.integers(len(names)))]
    with zipfile.ZipFile(target, "w") as archive:
        for name in names:
            content = source.read(name)
            archive.writestr(name, _part(content, rng) if name == chosen else content)
    return target.getvalue()


def _part(content: bytes, rng: np.random.Generator) -> bytes:
    is_json = content.startswith(b"{")
    return (
        damaged_json(content, rng)
        if is_json
        else damaged_text(content, rng)
        if rng.random() < 0.5
        else flir.mutate(content, rng)
    )


def read_frames(path: Path) -> None:
    """Read all frames of a file with their pixels, as a campaign does."""
    frames, rejected = index_recordings([path], STACK)
    if not frames:
        raise ThermographyError(rejected[0].reason)
    for frame in list(frames)[:4]:
        assert frame.read_counts().dtype == np.uint16


def read_flir(path: Path) -> None:
    """Read a FLIR file in every way: frames, and what `inspect` says of it."""
    flir.read_everything(path)
    inspect_file(path)


def read_laser(path: Path) -> object:
    """Read a file of the laser or its logs."""
    return (
        read_environment(path)
        if is_environment_log(path)
        else read_deviations(path, feed_mm_per_min=1000.0, dwell_s=2.0)
    )


def read_zarr(path: Path) -> None:
    """Read the Zarr store that a damaged archive holds."""
    folder = Path(tempfile.mkdtemp(dir=path.parent))
    try:
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
        read_frames(folder / "zarr.json" if (folder / "zarr.json").exists() else folder)
    finally:
        shutil.rmtree(folder)


def _named(path: Path, name: str, read: Callable[[Path], object], texts: dict[str, str]) -> None:
    """Read a file under the name that it has in a campaign, beside intact files."""
    folder = Path(tempfile.mkdtemp(dir=path.parent))
    try:
        for other, text in texts.items():
            (folder / other).write_text(text)
        shutil.copy(path, folder / name)
        read(folder)
    finally:
        shutil.rmtree(folder)


def read_campaign(path: Path) -> None:
    """Read a damaged campaign file beside the files that it names."""
    texts = {"long.csv": laser.LONG, "drivers.csv": DRIVERS}
    _named(path, "campaign.toml", lambda folder: load_campaign(folder / "campaign.toml"), texts)


def read_damaged_record(path: Path) -> None:
    """Read a damaged record by its campaign."""
    _named(
        path,
        "record.csv",
        lambda folder: read_record(load_campaign(folder / "campaign.toml")),
        {"campaign.toml": RECORD},
    )


def read_damaged_product(path: Path, *, results: Path, name: str) -> None:
    """Print a results folder with one damaged file, and export, compare, reproduce or report it."""

    def use(folder: Path) -> None:
        for other in {"results.json", "deviations.nc", "fusion.nc"} - {name}:
            (folder / other).symlink_to(results / other)
        if name != "provenance.json":
            # Without the hashes, as of an older run, by which what is damaged would be told before it is read.
            provenance = json.loads((results / "provenance.json").read_text(encoding="utf-8"))
            (folder / "provenance.json").write_text(json.dumps({**provenance, "products": {}}), encoding="utf-8")
        summary_rows(read_results(folder))
        commands: tuple[Callable[[], object], ...] = (
            lambda: export_results(folder, "csv", folder / "csv"),
            lambda: export_results(folder, "siemens840d", folder / "control", force=True),
            lambda: compare_campaigns([results, folder]),
            # The provenance is read before the campaign file is missed.
            lambda: reproduce(folder, campaign=folder / "absent.toml"),
        )
        # One of them, as one that refuses the folder would hide what another meets; a report of some, which takes long.
        size = len(path.read_bytes())
        report_of(folder) if size % 40 == 0 else commands[size % len(commands)]()

    _named(path, name, use, {})


def run_of_the_laser(folder: Path) -> Path:
    """Run a small test of the laser alone and return its results folder."""
    rng = np.random.default_rng(1)
    start = np.datetime64("2026-03-09T06:30", "s")
    rows = [
        f"{cycle + 1},{way},{target},{100 * target},{start + 100 * cycle + 10 * at}Z,{target + rng.normal(0.0, 0.3):.3f}"
        for cycle in range(12)
        for at, (way, target) in enumerate([("positive", t) for t in (1, 2, 3)] + [("negative", t) for t in (3, 2, 1)])
    ]
    (folder / "laser.csv").write_text("\n".join(["cycle,direction,target,position_mm,time,deviation_um", *rows]) + "\n")
    (folder / "campaign.toml").write_text(
        '[campaign]\ntitle = "X"\naxis = "X"\n[interferometry]\ndeviations = "laser.csv"\n[model]\ndeclared = []\n'
    )
    run_campaign(folder / "campaign.toml", folder / "results")
    return folder / "results"


def _files(folder: Path) -> dict[str, list[bytes]]:
    """Return intact files that a program has to write."""
    values = np.random.default_rng(1).normal(25.0, 1.0, (3, 8, 10)).astype("f4")
    time = np.datetime64("2026-03-09T06:30", "ns") + np.arange(3) * np.timedelta64(1, "s")
    stack = xr.DataArray(
        values, dims=("time", "y", "x"), coords={"time": time}, attrs={"units": "degC"}, name="temperature"
    )
    found: dict[str, list[bytes]] = {"tiff": [], "npy": [], "nc": [], "zarr": []}
    for photometric in (values, (40 * values).astype("u2")):
        tifffile.imwrite(folder / "a.tif", photometric, photometric="minisblack")
        found["tiff"].append((folder / "a.tif").read_bytes())
        np.save(folder / "a.npy", photometric)
        found["npy"].append((folder / "a.npy").read_bytes())
    tifffile.imwrite(folder / "a.tif", values, photometric="minisblack", compression="zlib")
    found["tiff"].append((folder / "a.tif").read_bytes())
    stack.to_netcdf(folder / "a.nc", engine="h5netcdf")
    found["nc"].append((folder / "a.nc").read_bytes())
    stack.to_dataset().to_zarr(folder / "a.zarr", consolidated=False, zarr_format=3)
    with zipfile.ZipFile(folder / "a.zip", "w") as archive:
        for item in sorted((folder / "a.zarr").rglob("*")):
            if item.is_file():
                archive.write(item, item.relative_to(folder / "a.zarr").as_posix())
    found["zarr"].append((folder / "a.zip").read_bytes())
    return found


def kinds_of_products(folder: Path) -> list[Kind]:
    """Return the kinds of files that come from the program itself: for the terminal, `export`, `compare`, `reproduce` and `report`."""
    results = run_of_the_laser(folder)
    damaged = {"results.json": damaged_json, "provenance.json": damaged_json, "deviations.nc": flir.mutate}
    return [
        Kind(
            name,
            [(results / name).read_bytes()],
            damage,
            partial(read_damaged_product, results=results, name=name),
            0.05,
        )
        for name, damage in damaged.items()
    ]


def kinds_of_inputs(folder: Path) -> list[Kind]:
    """Return the kinds of files that a user gives to the program.

    Parameters
    ----------
    folder : Path
        For intact files while they are made.
    """
    made, text = _files(folder), damaged_text
    frames_text = "\n".join(";".join(f"{20 + x / 10 + y:.1f}" for x in range(12)) for y in range(9))
    return [
        Kind("flir.seq", flir.seeds(folder), flir.mutate, read_flir, 3.0),
        Kind("long.csv", [laser.LONG.encode(), laser.LONG.replace(",", ";").encode("utf-16")], text, read_laser, 2.0),
        Kind("wide.csv", [laser.WIDE.encode(), laser.WIDE.encode("utf-16")], text, read_laser),
        Kind("environment.csv", [laser.LOG.encode()], text, read_laser),
        Kind("test.rtl", [laser.RTL.encode()], text, read_laser, 2.0),
        Kind("log.dat", [laser.ECMC.encode()], text, read_laser),
        Kind("long.xlsx", [laser._workbook(folder)], damaged_archive, read_laser),
        Kind("long.xls", [old_workbook()], damaged_compound, read_laser),
        Kind("drivers.csv", [DRIVERS.encode()], text, read_drivers),
        Kind("record.csv", [TABLE.encode()], text, read_damaged_record, 0.5),
        Kind("fiducials.csv", [FIDUCIALS.encode()], text, read_fiducials),
        Kind("regions.csv", [REGIONS.encode()], text, read_regions),
        Kind("lens.yaml", [LENS.encode()], text, read_lens),
        Kind("campaign.toml", [CAMPAIGN.encode()], text, read_campaign, 0.5),
        Kind("recipe.toml", [RECIPE.encode()], text, read_recipe, 0.5),
        Kind("frame.csv", [frames_text.encode()], text, read_frames),
        Kind("frames.tif", made["tiff"], flir.mutate, read_frames),
        Kind("frames.npy", made["npy"], flir.mutate, read_frames),
        Kind("frames.nc", made["nc"], flir.mutate, read_frames, 0.2),
        Kind("frames.zarr.zip", made["zarr"], damaged_part, read_zarr, 0.1),
    ]
