"""Writes a simulated campaign as the files that the instruments of a laboratory would write, with the truth in a folder next to it."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from fusion.common import CAMPAIGN_FILE, Array, FusionError
from fusion.twin.camera import KELVIN, SC660, Renderer, counts_of, fiducial_points, make_view, reflected_spot
from fusion.twin.folders import check_free, whole_folders, write_truth_nc
from fusion.twin.machine import stream
from fusion.twin.recipe_file import find_recipe, read_recipe
from fusion.twin.record import simulate_record, write_record
from fusion.twin.simulate import PROBE_MM, Truth, driver_log, environment_log, moving_rms, simulate
from interferometry.io.writers import write_deviations_csv, write_environment_csv, write_rtl
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import CalibratedRange, CameraIdentity, CameraParameters, Frame

Progress = Callable[[int, int, str], None]
#: Cell size of the true temperature fields in truth.nc.
TRUTH_CELL_MM = 2.5
IDENTITY = CameraIdentity(
    model="FLIR SC660", part="TWIN", serial="0", software="1.0", lens_model="FOL38", field_of_view_deg=23.9
)
RANGE = CalibratedRange(minimum_K=233.15, maximum_K=393.15, raw_minimum=8812, raw_maximum=57240)


def simulate_campaign(recipe: str | Path, out: str | Path, *, progress: Progress | None = None) -> Path:
    """Simulate the campaign that a recipe describes and write it as files.

    Parameters
    ----------
    recipe : str or Path
        RECIPE.toml, with the tables of :class:`fusion.twin.recipe.Recipe`; what it leaves out keeps its default. Or the name of a recipe
        that comes with the package: ``demo``, ``paper`` or ``record``.
    out : str or Path
        Folder of the campaign; the truth goes to ``<out>-truth`` beside it. Both must be absent or empty.
    progress : callable or None
        Called as ``progress(done, total, what)`` after every frame.

    Returns
    -------
    Path
        The campaign file, ``<out>/campaign.toml``. The same recipe writes the same bytes.

    Raises
    ------
    RecipeError
        The recipe cannot be read, is not TOML, or asks for what no machine can be; or one of the two folders is not empty or cannot be
        written to, and both are as they were before.

    Notes
    -----
    Physics of the simulated machine, camera and laser: docs/method/effects.md. It shares no code with the analysis.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = (folder / "recipe.toml").write_text("test.cycles = 2")
    >>> campaign = simulate_campaign(folder / "recipe.toml", folder / "campaign")
    >>> sorted(path.name for path in campaign.parent.iterdir())
    ['campaign.toml', 'drivers.csv', 'environment.csv', 'fiducials.csv', 'laser.csv', 'thermal']
    """
    described, out = read_recipe(find_recipe(recipe)), Path(out)
    if described.record is None:
        check_free(out)
        return write_campaign(simulate(described), out, progress=progress)
    truth = simulate_record(described)
    with whole_folders(out) as (folder, beside):
        write_record(truth, folder, beside)
    return out / CAMPAIGN_FILE


def write_campaign(truth: Truth, out: Path, *, progress: Progress | None = None) -> Path:
    """Write a simulated campaign: frames, laser, environment, drivers, fiducials, campaign file; the truth next to it."""
    out = Path(out)
    with whole_folders(out) as (folder, truth_folder):
        _write_laser(truth, folder)
        write_environment_csv(folder / "environment.csv", environment_log(truth))
        _write_drivers(truth, folder / "drivers.csv")
        _write_fiducials(truth, folder / "fiducials.csv")
        (folder / CAMPAIGN_FILE).write_text(_campaign_text(truth), encoding="utf-8")
        _write_truth(truth, truth_folder)
        _write_frames(truth, folder / "thermal", progress)
    return out / CAMPAIGN_FILE


def _campaign_text(truth: Truth) -> str:
    """Return the campaign file that the operator of this machine would write, with what the operator knows."""
    recipe = truth.recipe
    camera, plan = recipe.camera, recipe.plan
    clock = f'clock_offset = "{camera.clock_offset_s:g} s"\n' if camera.state_clock_offset else ""
    # A .rtl file holds no times of readings, which are reconstructed from feed and dwell, and no zone.
    test, duty = recipe.test, recipe.duty
    motion = f'time_zone = "UTC"\nfeed = "{test.feed_mm_per_min:g} mm/min"\ndwell = "{test.dwell_s:g} s"\n'
    law = ""
    if duty.kind == "randomised":
        law = f'mean_dwell = "{duty.mean_hold_min:g} min"\nleast_dwell = "{duty.least_hold_min:g} min"\n'
        law = f'randomised = ["duty [1]"]\n{law}'
    further = recipe.campaign.further and f"\n{recipe.campaign.further}"
    return f"""[campaign]
title = {json.dumps(recipe.campaign.title)}
axis = {json.dumps(recipe.campaign.axis)}

[thermography]
frames = ["thermal/*.{camera.file}"]
emissivity = {camera.emissivity:g}
reflected_temperature = "{camera.reflected_temperature_degC:g} degC"
atmospheric_temperature = "{camera.atmospheric_temperature_degC:g} degC"
relative_humidity = {camera.relative_humidity:g}
object_distance = "{camera.distance_mm * 1e-3:g} m"
{clock}table = "{camera.table}"

[plan]
size = ["{plan.width_mm:g} mm", "{plan.height_mm:g} mm"]
cell_size = "5 mm"
fiducials = "fiducials.csv"

[plan.axis]
origin = ["{plan.origin_mm[0]:g} mm", "{plan.origin_mm[1]:g} mm"]
direction = [{plan.direction[0]:g}, {plan.direction[1]:g}]

[interferometry]
deviations = "laser.{recipe.laser.file}"
{motion if recipe.laser.file == "rtl" else ""}environment = "environment.csv"
dead_path = "0 mm"
expansion_coefficient = "{recipe.laser.stated_expansion_ppm_per_K:g} ppm/K"
material_sensor = ["{PROBE_MM[0]:g} mm", "{PROBE_MM[1]:g} mm"]

[drivers]
file = "drivers.csv"
{law}
[model]
declared = ["axis_expansion", "table_offset"]
{further}"""


def _write_laser(truth: Truth, out: Path) -> None:
    """Write the deviations in the order they were taken; a lost reading has no row (CSV) or the sentinel (.rtl)."""
    deviations = truth.readings[["deviation", "time"]]
    if truth.recipe.laser.file == "rtl":
        log = environment_log(truth)
        ends = {f"{name}_{one.attrs['units']}": (float(one[0]), float(one[-1])) for name, one in log.items()}
        write_rtl(out / "laser.rtl", deviations, environment=ends, user_text={"axis": truth.recipe.campaign.axis})
    else:
        write_deviations_csv(out / "laser.csv", deviations)


def _write_rows(path: Path, *rows: Sequence[str]) -> None:
    """Write a table as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def _write_drivers(truth: Truth, path: Path) -> None:
    """Write the load as logged once a minute."""
    log = driver_log(truth)
    times = np.datetime_as_string(log["time"].values, unit="ms")
    rows = ([f"{time}+00:00", f"{duty:.3f}"] for time, duty in zip(times, log["duty"].values, strict=True))
    _write_rows(path, ["time", "duty [1]"], *rows)


def _write_fiducials(truth: Truth, path: Path) -> None:
    """Write the discs' places on the plan with rough pixel positions, as read off a screen."""
    plan = truth.recipe.plan
    points = fiducial_points(plan)
    pixels = make_view(truth.recipe.camera).to_sensor(points)
    pixels += stream(truth.recipe.campaign.seed, "pixel hints").normal(0.0, plan.hint_error_px, pixels.shape)
    rows = [["name", "x_mm", "y_mm", "diameter_mm", "column_px", "row_px"]]
    for number, (point, pixel) in enumerate(zip(points, pixels, strict=True), 1):
        place = [f"{value:g}" for value in (*point, plan.fiducial_diameter_mm)]
        rows.append([f"F{number}", *place, *(f"{value:.0f}" for value in pixel)])
    _write_rows(path, *rows)


def _write_truth(truth: Truth, folder: Path) -> None:
    """Write truth.nc (readings and their parts, fields at the frames' times) and truth.json (numbers)."""
    plan, recipe = truth.recipe.plan, truth.recipe
    x = np.arange(0.5 * TRUTH_CELL_MM, plan.width_mm, TRUTH_CELL_MM, dtype=float)
    y = np.arange(0.5 * TRUTH_CELL_MM, plan.height_mm, TRUTH_CELL_MM, dtype=float)
    per_cycle = (np.arange(truth.schedule.cycles, dtype=float) + 0.5) * truth.schedule.period_s
    field_s = truth.session.frame_s if recipe.camera.table == "still" else per_cycle
    temperature = truth.temperature(field_s, x, y, cell_mm=TRUTH_CELL_MM).astype(np.float32)
    fields = xr.Dataset(
        {"temperature": (("field_time", "y", "x"), temperature, {"units": "degC"})},
        coords={"field_time": truth.clock(field_s).astype("datetime64[ns]"), "y": y, "x": x},
    )
    write_truth_nc(folder, xr.merge([truth.readings.drop_encoding(), fields, truth.frames]))
    view = make_view(recipe.camera)
    knock = {"cycle": recipe.camera.knock_cycle, "px": list(recipe.camera.knock_px)}
    moving = {name: moving_rms(truth.in_order(name), truth.session) for name in truth.parts}
    content = {
        "recipe": asdict(recipe),
        "parts_rms_um": moving,
        "declared": ["axis_expansion", "table_offset"],
        "undeclared": [effect.name for effect in recipe.effect],
        "anomalies": [asdict(anomaly) for anomaly in recipe.anomaly],
        "clock_offset_s": recipe.camera.clock_offset_s,
        "plan_to_sensor": view.homography.tolist(),
        "distortion": {"k1": view.k1, "focal_px": view.focal_px, "centre_px": list(view.centre_px)},
        "knock": knock if recipe.camera.knock_cycle else None,
    }
    (folder / "truth.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _write_frames(truth: Truth, folder: Path, progress: Progress | None) -> None:
    """Render every frame and write it as the camera would, with its clock, its settings and its own temperatures."""
    folder.mkdir()
    if truth.recipe.camera.file == "seq":
        write_sequence(folder / "IR_0001.seq", _frames(truth, progress))
        return
    for number, frame in enumerate(_frames(truth, progress), 1):
        told: dict[str, Any] = {"camera": frame.camera, "limits": frame.limits, "housekeeping": frame.housekeeping}
        write_jpeg(folder / f"IR_{number:04d}.jpg", frame.counts, frame.parameters, frame.time, **told)


def _frames(truth: Truth, progress: Progress | None) -> Iterator[Frame]:
    """Yield the frames in the order they are taken."""
    camera = truth.recipe.camera
    renderer = Renderer(truth)
    parameters = CameraParameters(
        emissivity=camera.emissivity,
        object_distance_m=camera.distance_mm * 1e-3,
        reflected_temperature_K=camera.reflected_temperature_degC + KELVIN,
        atmospheric_temperature_K=camera.atmospheric_temperature_degC + KELVIN,
        window_temperature_K=camera.atmospheric_temperature_degC + KELVIN,
        window_transmission=1.0,
        stored_transmission=0.0,
        relative_humidity=camera.relative_humidity,
        **SC660,
    )
    times = truth.clock(truth.session.frame_s + camera.clock_offset_s)
    housing = truth.frames["housing"].values + KELVIN
    for number, time in enumerate(times):
        yield Frame(
            counts=renderer.render(number),
            parameters=parameters,
            time=time,
            camera=IDENTITY,
            limits=RANGE,
            housekeeping={"TSShutter": float(housing[number]), "TSLens": float(housing[number]) - 0.8},
        )
        if progress is not None:
            progress(number + 1, times.size, "render frames")


# The truth as the Datasets that ideal instruments and an ideal reduction would hand over, without files.

# Studies by simulation run hundreds of campaigns; rendering and reading frames would take nearly all of their time. These Datasets keep
# the contracts of the instruments' own. The fields carry the noise that remains after averaging a frame over a cell.

_ON_SCALE = {"units": "degC", "units_metadata": "temperature: on_scale"}
_DIFFERENCE = {"units": "K", "units_metadata": "temperature: difference"}


def deviations_of(truth: Truth) -> xr.Dataset:
    """Return the measured deviations of a simulated campaign."""
    measured = truth.readings[["deviation", "time"]].copy()
    measured["time"] = measured["time"].where(measured["deviation"].notnull())
    measured["time"].attrs = {"long_name": "time of the reading, recorded"}
    measured["quality_flag"] = (measured["deviation"].dims, np.zeros(measured["deviation"].shape, dtype=np.uint8))
    measured["quality_flag"].attrs["units"] = "1"
    return measured


def fields_of(truth: Truth, *, cell_size_mm: float = 5.0, noise_K: float | None = None) -> xr.Dataset:
    """Return the table's temperature per cycle on the plan grid, as the frames of a still table would give it."""
    camera, plan = truth.recipe.camera, truth.recipe.plan
    if camera.table != "still":
        raise FusionError(
            "fields_of needs camera.table = 'still'; write the campaign and reduce its frames for a moving table"
        )
    centre_x = (np.arange(round(plan.width_mm / cell_size_mm), dtype=float) + 0.5) * cell_size_mm
    centre_y = (np.arange(round(plan.height_mm / cell_size_mm), dtype=float) + 0.5) * cell_size_mm
    frames = truth.temperature(truth.session.frame_s, centre_x, centre_y, cell_mm=cell_size_mm)
    frames += truth.frames["camera_offset_K"].values[:, None, None]
    frames += truth.frames["reflected_K"].values[:, None, None] * _reflection_gain(truth, centre_x, centre_y)
    pixels = _pixels_per_cell(truth, cell_size_mm)
    sigma = camera.netd_K / np.sqrt(pixels) if noise_K is None else noise_K
    frames += sigma * stream(truth.recipe.campaign.seed, "cell noise").standard_normal(frames.shape)
    cycles, burst = truth.schedule.cycles, camera.frames_per_cycle
    by_cycle = frames.reshape(cycles, burst, *frames.shape[1:])
    mean = by_cycle.mean(axis=1)
    dims = ("cycle", "y", "x")
    uncertainty = np.full(mean.shape, sigma / np.sqrt(burst))
    middle_s = truth.session.frame_s.reshape(cycles, burst).mean(axis=1)
    return xr.Dataset(
        {
            "temperature": (dims, mean, _ON_SCALE),
            "temperature_u": (dims, uncertainty, _DIFFERENCE),
            "temperature_rise": (dims, mean - mean[0], _DIFFERENCE),
            "temperature_rise_u": (dims, np.sqrt(2.0) * uncertainty, _DIFFERENCE),
            "temperature_noise_u": (dims, uncertainty, _DIFFERENCE),
            "temperature_rise_noise_u": (dims, np.sqrt(2.0) * uncertainty, _DIFFERENCE),
            "rise_scale_u": (dims[1:], np.zeros(uncertainty.shape[1:]), {"units": "1"}),
            "rise_reflected_u": ("cycle", np.zeros(cycles), _DIFFERENCE),
            "temperature_spread": (dims, by_cycle.std(axis=1), _DIFFERENCE),
            "count": (dims, np.full(mean.shape, burst, dtype=np.int32), {"units": "1"}),
            "cycle_time": ("cycle", truth.clock(middle_s).astype("datetime64[ns]")),
            "frame_temperature": (("time", "y", "x"), frames, _ON_SCALE),
        },
        coords={
            "cycle": truth.readings["cycle"].values,
            "time": truth.clock(truth.session.frame_s).astype("datetime64[ns]"),
            "y": ("y", centre_y, {"units": "mm"}),
            "x": ("x", centre_x, {"units": "mm"}),
        },
    )


def _pixels_per_cell(truth: Truth, cell_size_mm: float) -> float:
    """Return how many pixels a cell in the middle of the plan covers."""
    view = make_view(truth.recipe.camera)
    centre = np.array([truth.recipe.plan.width_mm, truth.recipe.plan.height_mm]) / 2.0
    corners = centre + 0.5 * cell_size_mm * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    column, row = view.to_sensor(corners).T
    return float(0.5 * abs(np.dot(column, np.roll(row, -1)) - np.dot(row, np.roll(column, -1))))


def _reflection_gain(truth: Truth, x_mm: Array, y_mm: Array) -> Array:
    """Return by how many K a cell (y, x) reads high per K of a body that is reflected in it."""
    recipe = truth.recipe
    reflected, start = recipe.camera.reflected_temperature_degC, recipe.table.initial_temperature_degC
    per_K = [counts_of(at + 0.5) - counts_of(at - 0.5) for at in (reflected, start)]
    gain = (1.0 - recipe.camera.emissivity) / recipe.camera.emissivity * float(per_K[0] / per_K[1])
    return gain * reflected_spot(recipe, x_mm, y_mm[:, None])
