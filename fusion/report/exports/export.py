"""Exports of a results folder: what is asked for is made in memory, judged by the guard, and written without overwriting anything."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from fusion.analysis.drift_model.recursion import make_recursion
from fusion.analysis.predicted_test import in_order, predict_values, scatter_and_drift
from fusion.common import Array
from fusion.common.messages import naming
from fusion.report.exports import controls, tables
from fusion.report.wording import sentences
from fusion.results.axis import AnomalyPart, HotspotPart
from fusion.results.loop import RecordLoop
from fusion.results.numbers import moment
from fusion.results.parts import PREDICTION_ENDING, ByDirection, Quantity, TablePrediction
from fusion.results.results import Results, read_results
from fusion.results.store import file_sha256, group, has, has_product, read_product, write_atomically
from interferometry.iso230 import STANDARD_CYCLES
from thermography.common import write_csv
from thermography.pictures import write_gif, write_mp4
from thermography.plots import SHEET_COLUMNS, cycles_on_sheet, draw_field, field_scale, plot_field

# The guard of compensation tables: why a run's profile should not go into a control, and what to know where it may.


def objections(results: Results) -> list[str]:
    """Return why a compensation table should not be made from a run."""
    return sentences("objections", results, [one for one in results.anomalies or () if _moves(one)])


def remarks(results: Results) -> list[str]:
    """Return what to know of single positions of a table that may be made."""
    return sentences("not_corrected", [one for one in results.anomalies or () if not _moves(one)])


def _moves(anomaly: AnomalyPart) -> bool:
    """Whether the mean of a position depends on when it was measured, for no reason that the results name."""
    return anomaly.evidence.kind not in ("scatter", "link") and anomaly.cause != "local_temperature"


# What a compensation table is predicted to do.


def predict(profile: controls.Profile, table: controls.ErrorTable, *, one_table: bool) -> dict[str, float]:
    """Return what the header says of a control that interpolates linearly between the points of a table, free of drift, um.

    E of ISO 230-2 without the table (`before_um`), what it leaves of its own profile (`own_um`), the largest departure of its lines
    from the profile at a target (`resampling_um`), and the largest standard uncertainty of a value (`value_u_um`).
    """
    relative = profile.deviation_um - np.interp(table.reference_mm, profile.position_mm, profile.deviation_um[0])
    return {
        "before_um": float(np.ptp(profile.deviation_um)),
        "own_um": float(np.ptp(remainder_um(profile, table, one_table=one_table))),
        "resampling_um": float(np.abs(relative - table.added_um(profile.position_mm, one_table=False)).max()),
        "value_u_um": float(table.u_um.max()),
    }


def predict_test(
    profile: controls.Profile,
    table: controls.ErrorTable,
    scatter_um: Array,
    drift_um: Array,
    freedom: float = np.inf,
    *,
    cycles: int,
    one_table: bool,
) -> dict[str, Quantity]:
    """Predict A, E, M and B of a test with an active table, which has the drift of some successive cycles of this one."""
    courses = [drift_um[start : start + cycles] for start in range(max(1, len(drift_um) - cycles + 1))]
    left = remainder_um(profile, table, one_table=one_table)
    return predict_values(
        left, profile.covariance_um2, scatter_um, courses, freedom, cycles=cycles, one_table=one_table
    )


def remainder_um(profile: controls.Profile, table: controls.ErrorTable, *, one_table: bool) -> Array:
    """Return what a table leaves of a profile at the targets (2, n), up to a constant."""
    return profile.deviation_um - table.added_um(profile.position_mm, one_table=one_table)


#: Setting data that follow a temperature.
TEMPERATURE_FORMAT = "siemens840d-temperature"
_PICTURES = ("png", "gif", "mp4")
FORMATS = ("csv", "xlsx", *_PICTURES, *controls.CONTROLS, TEMPERATURE_FORMAT, *controls.MODELS)
_NO_LASER = "this campaign has no laser, so there is neither drift nor profile to write; --format csv and xlsx write its temperatures"
#: Name of an axis that every control accepts.
_AXIS = re.compile(r"[A-Za-z][A-Za-z0-9]{0,9}")

_NO_PLAN = (
    "it holds no temperatures on a plan of the table, so that there is no map to draw; thermofuse inspect FRAMES --export FOLDER "
    "--format png draws the frames of a camera"
)

Writer = Callable[[Path], object]


@dataclass(frozen=True)
class Exported:
    """The files that an export wrote, and what to know of them, one sentence each."""

    files: tuple[Path, ...]
    remarks: tuple[str, ...] = ()


def export_results(
    results: str | Path,
    format: str,
    out: str | Path,
    *,
    axis: str | None = None,
    spacing_mm: float | None = None,
    reference_mm: float | None = None,
    active: str | None = None,
    sampling_s: float = 1.0,
    reduced: bool = False,
    fields: bool = False,
    force: bool = False,
    overwrite: bool = False,
) -> Exported:
    """Write tables of a run, the drift-free profile as the compensation table of a control, or the drift model for a control.

    Parameters
    ----------
    results : str or Path
        Folder of a finished run.
    format : {"csv", "xlsx", "png", "gif", "mp4", "linuxcnc", "siemens840d", "siemens840d-temperature", "heidenhain", "twincat", \
"model-json", "model-c", "model-st", "model-linuxcnc"}
        Tables, a workbook, maps of the table (every cycle as PNG with a contact sheet, or a film of all), or a control;
        ``siemens840d-temperature`` is the part of the drift that follows the material temperature. The model of a record's
        drift as JSON, as a header in C, in Structured Text, or as a HAL component.
    out : str or Path
        Folder for the files; created where it is absent.
    axis : str, optional
        Name of the axis in the control. None: the axis of the campaign.
    spacing_mm : float, optional
        Largest distance of the table's equally spaced points. None: the targets themselves, and the points of an active table.
    reference_mm : float, optional
        Position at which the correction is zero. None: 0 mm, or the target nearest to it.
    active : str, optional
        The table that was active during the test, a file in the format of the control, or "none": what was measured is added to it. None:
        as the campaign states it as ``machine_compensation`` of ``[report]``.
    sampling_s : float
        Time from one step of a model to the next, s.
    reduced : bool
        Whether a model uses the fewest sensors that suffice.
    fields : bool
        Whether ``csv`` writes the fields too, which makes a large file.
    force : bool
        Write a compensation table although something speaks against it; the reason is written into its header.
    overwrite : bool
        Replace files that exist.

    Returns
    -------
    Exported
        ``csv``: ``drift.csv``, ``profile.csv``, ``iso230.csv``, ``iso230_positions.csv``, and ``fields.csv`` where it was asked for;
        ``xlsx``: ``results.xlsx``; ``png``: ``contact_sheet.png``, ``cycle_0001.png`` ...; ``gif``, ``mp4``: ``cycles.gif``,
        ``cycles.mp4``; a control: one table, with a README where its dialect has no comments.

    Raises
    ------
    ExportError
        If the folder holds no results, a file exists, the positions do not suit the control, or something speaks against a compensation
        table: a verdict other than complete or explained, a doubted input, a position that moves unlike the others, or that it is not
        known whether a table was active during the test.

    Notes
    -----
    Formats, signs and their sources: `fusion.report.exports.controls`. A table corrects the profile at the mean thermal state of the
    test; what moves with the temperature is not in it.

    Examples
    --------
    >>> from fusion import export_results
    >>> export_results("results", "csv", "results/export")  # doctest: +SKIP
    """
    if format not in FORMATS:
        raise controls.ExportError(f'there is no format "{format}"; write one of {", ".join(FORMATS)}')
    folder, found = Path(results), read_results(Path(results))
    if format in controls.MODELS:
        content, notes = _model_text(folder, found, format, sampling_s=sampling_s, reduced=reduced, force=force)
    elif format in _PICTURES:
        if not has_product(folder, "fields.nc"):
            raise controls.ExportError(f"{folder}: {_NO_PLAN}")
        content = draw_maps(read_product(folder, "fields"), found.hotspots or (), found.campaign, format)
        notes = []
    elif not has_product(folder, "deviations.nc"):
        content, notes = _written(_tables_without_laser(folder, found, format), format), []
    elif format in ("csv", "xlsx"):
        deviations = read_product(folder, "deviations")
        made = (
            _csv_tables(folder, found, deviations, with_fields=fields)
            if format == "csv"
            else tables.axis_tables(found, deviations)
        )
        size = None if fields or format == "xlsx" else tables.fields_megabytes(folder)
        content = _written(made, format)
        notes = [] if size is None else [f"fields.csv (about {size:.0f} MB) is written where --fields is given"]
    else:
        run = _read_run(folder, found)
        with naming(folder):
            texts, notes = (
                _temperature_text(run, axis, reference_mm, force=force)
                if format == TEMPERATURE_FORMAT
                else _table_texts(run, controls.CONTROLS[format], axis, spacing_mm, reference_mm, active, force=force)
            )
        content = {name: partial(Path.write_text, data=text, encoding="ascii") for name, text in texts.items()}
    return Exported(_write(Path(out), content, overwrite=overwrite), tuple(notes))


@dataclass(frozen=True)
class _Run:
    """A results folder that was read, and what a header says of it."""

    folder: Path
    results: Results
    deviations: xr.Dataset
    origin: controls.Origin


def _read_run(folder: Path, results: Results) -> _Run:
    """Read the run that the table of a control is made from."""
    deviations = read_product(folder, "deviations")
    if not has(deviations, "estimate"):
        raise controls.ExportError(
            f"{folder}: the readings have no times, or are too few, so there is neither drift nor profile to write; --format csv and xlsx "
            "give the values by ISO 230-2"
        )
    return _Run(
        folder,
        results,
        deviations,
        controls.read_origin(folder, results, controls.read_thermal_state(folder, deviations)),
    )


def _table_texts(
    run: _Run,
    control: controls.Control,
    axis: str | None,
    spacing_mm: float | None,
    reference_mm: float | None,
    given: str | None,
    *,
    force: bool,
) -> tuple[dict[str, str], list[str]]:
    """Return the files of a control's table by name, and what to tell the user."""
    active, unknown = controls.read_active(run.folder, control, run.origin, given)
    against = _judge([*objections(run.results), *unknown], force=force)
    profile = controls.read_profile(run.deviations)
    table = controls.tabulate(profile, spacing_mm=spacing_mm, reference_mm=reference_mm, active=active)
    if control.most_points is not None and table.position_mm.size > control.most_points:
        raise controls.ExportError(
            f"{table.position_mm.size} points; {control.words} reads at most {control.most_points}, choose a wider --spacing"
        )
    if control.equal_spacing and table.spacing_mm() is None:
        distances = sorted({round(float(step), 4) for step in table.position_mm[1:] - table.position_mm[:-1]})
        raise controls.ExportError(
            f"{control.words}: needs equally spaced points; these are {distances[0]:g} to {distances[-1]:g} mm apart, as ISO 230-2 asks "
            f'for: resample them, for example with --spacing "{distances[len(distances) // 2]:.0f} mm"'
        )
    name = _axis_name(run, axis, needed=control.names_axis)
    file = control.file_name.format(axis=name) if name else control.file_name.replace("_{axis}", "")
    facts: dict[str, Any] = {"words": control.words, "axis": name, "table": table, "sign": control.sign}
    facts |= {"loading": control.loading, "unknown": unknown}
    facts["prediction"] = predict(profile, table, one_table=control.one_table)
    facts["tested"] = tested = _predict_test(run, profile, table, control, file)
    facts["with_table"] = run.results.iso230.with_table if run.results.iso230 else None
    facts["between_um"] = (controls.path_variance(profile) * table.widest_gap_mm / 4.0) ** 0.5
    header = controls.header_lines(run.origin, **facts, objections=against, remarks=remarks(run.results))
    texts = {file: control.write(table, name, header if control.comment else ())}
    texts[f"{file}{PREDICTION_ENDING}"] = json.dumps(tested.model_dump(mode="json"), indent=2) + "\n"
    if not control.comment:
        texts[f"{file}.README.txt"] = "\n".join(header) + "\n"
    missing = (
        [f"A, E, M and B with the table are not predicted: {tested.not_predicted}"] if tested.not_predicted else []
    )
    return texts, [*_forced(against), *remarks(run.results), *missing]


def _predict_test(
    run: _Run, profile: controls.Profile, table: controls.ErrorTable, control: controls.Control, file: str
) -> TablePrediction:
    """Return what a test with the table is predicted to show, for ``thermofuse compare --applied``."""
    iso = run.results.iso230
    cycles = len(iso.cycles) if iso is not None and iso.cycles else STANDARD_CYCLES
    forward, reverse = table.added_um(table.position_mm, one_table=control.one_table).tolist()
    drift = in_order(group(run.deviations, "estimate").assign(position=run.deviations["position"]))
    predicted = predict_test(
        profile, table, *scatter_and_drift(drift), cycles=max(cycles, 2), one_table=control.one_table
    )
    return TablePrediction(
        table=file,
        campaign=run.results.campaign,
        results_sha256=run.origin.results_sha256,
        cycles=cycles,
        position_mm=tuple(table.position_mm.tolist()),
        correction_um=ByDirection(positive=tuple(forward), negative=tuple(reverse)),
        predicted_um=predicted,
        not_predicted=""
        if predicted
        else "the readings do not show their scatter beside the drift: measure more cycles",
    )


def _temperature_text(
    run: _Run, axis: str | None, reference_mm: float | None, *, force: bool
) -> tuple[dict[str, str], list[str]]:
    """Return the file of the temperature compensation by name, and what to tell the user."""
    there = has_product(run.folder, "fusion.nc")
    material = read_product(run.folder, "fusion").get("material_temperature") if there else None
    if material is None:
        raise controls.ExportError(
            f"{run.folder}: no material temperature was logged; a temperature line needs one ([interferometry] environment)"
        )
    targets = run.deviations["position"].values
    reference = float(np.clip(0.0, targets.min(), targets.max())) if reference_mm is None else reference_mm
    line = controls.fit_temperature_line(run.deviations, material, reference_mm=reference)
    against = _judge([*objections(run.results), *line.objections()], force=force)
    name = _axis_name(run, axis, needed=True)
    words = "Siemens SINUMERIK 840D, temperature compensation (SD43900, SD43910, SD43920)"
    sign = "the compensation value K0(T) + tan beta(T) (P - P0) is the measured error line: measured minus programmed"
    facts = {"words": words, "axis": name, "line": line, "sign": sign}
    header = controls.header_lines(run.origin, **facts, objections=against, remarks=())
    return {f"temperature_{name}.MPF": controls.siemens_temperature(line, name, header)}, _forced(against)


def _model_text(
    folder: Path, results: Results, format: str, *, sampling_s: float, reduced: bool, force: bool
) -> tuple[dict[str, Writer], list[str]]:
    """Return the file of a record's drift model for a control, and what to tell the user."""
    if not isinstance(results.loop, RecordLoop):
        if not has_product(folder, "deviations.nc"):
            raise controls.ExportError(f"{folder}: {_NO_LASER}")
        raise controls.ExportError(
            f"{folder}: a drift model is written from a test with temperature sensors ([record]); that of an axis follows a camera, which "
            "does not stay at the machine: export a compensation table, or siemens840d-temperature"
        )
    if not 0.0 < sampling_s <= 60.0:
        raise controls.ExportError(
            f"--sampling {sampling_s:g} s does not suit a thermal state; write a time above 0 and up to 60 s"
        )
    product = read_product(folder, "record")
    constant, against = product.attrs.get("constant_drivers"), controls.objections_to_model(results)
    if constant and not product.sizes["driver_name"]:
        against.append(f"nothing shows how the machine responds to what never changed in the test: {constant}")
    against = _forced(_judge(against, force=force))
    with naming(folder):
        model = make_recursion(
            product,
            results.loop,
            campaign=results.campaign,
            results_sha256=file_sha256(folder / "results.json"),
            sampling_s=sampling_s,
            reduced=reduced,
            remarks=against,
        )
        file, text = controls.emit(model, format)
    curve = [
        f"{len(one.sensors)} of {len(model.sensor_curve[0].sensors)} sensors: {one.cross_rmse:.3g} um by cross-validation, "
        f"{one.held_out_rmse:.3g} um on the hold-out set ({', '.join(one.sensors) or 'none'})"
        for one in model.sensor_curve
    ]
    return {file: partial(Path.write_text, data=text, encoding="utf-8")}, [*model.remarks, *curve]


def _judge(against: list[str], *, force: bool) -> list[str]:
    """Return the objections of an export that is forced; refuse one that is not."""
    if against and not force:
        raise controls.ExportError(
            f"no compensation is written: {'; '.join(against)}. Remove the cause and run again, or add --force: the reason "
            "is then written into it"
        )
    return against


def _forced(against: Sequence[str]) -> list[str]:
    return [f"forced, although {reason}" for reason in against]


def _axis_name(run: _Run, given: str | None, *, needed: bool) -> str:
    """Return the name of the axis in the control: as given, else the campaign's; empty where there is none and none is needed."""
    stated = given if given is not None else run.origin.axis
    if _AXIS.fullmatch(stated):
        return stated
    if given is None and not needed:
        return ""
    why = f'"{stated}" is no name of an axis' if stated else "the campaign does not state the axis"
    raise controls.ExportError(f"{why}; write a letter and up to nine letters or digits, for example --axis X1")


def _tables_without_laser(folder: Path, results: Results, format: str) -> dict[str, pd.DataFrame]:
    """Return the tables by title that a record has, or a campaign of the camera alone; nothing of it is the table of a control."""
    record = isinstance(results.loop, RecordLoop)
    if format not in ("csv", "xlsx"):
        raise controls.ExportError(
            f"{folder}: a record of displacements has no target positions, so there is no profile to write; --format csv and xlsx write "
            f"its tables, model-json, model-c, model-st and model-linuxcnc its drift for a control"
            if record
            else f"{folder}: {_NO_LASER}"
        )
    if record:
        return tables.record_tables(results, read_product(folder, "record"))
    if has_product(folder, "fields.nc") and format == "csv":
        return {"fields": tables.fields_table(folder)}
    if not (frames := tables.camera_tables(results, folder)):
        raise controls.ExportError(
            f"{folder}: it holds results.json alone, no product to write; run the campaign again"
        )
    return frames


def _written(frames: dict[str, pd.DataFrame], format: str) -> dict[str, Writer]:
    """Return what writes tables by title: one workbook, or a CSV file of each."""
    if format == "xlsx":
        return {"results.xlsx": lambda path: tables.write_workbook(path, frames)}
    return {f"{title.lower().replace(' ', '_')}.csv": partial(write_csv, frame) for title, frame in frames.items()}


def _csv_tables(
    folder: Path, results: Results, deviations: xr.Dataset, *, with_fields: bool
) -> dict[str, pd.DataFrame]:
    """Return the tables of an axis by the name of their file."""
    timed = has(deviations, "estimate")
    frames = {
        "drift" if timed else "readings": tables.readings_table(deviations),
        **({"profile": tables.profile_table(deviations)} if timed else {}),
        "iso230": tables.iso230_axis_table(deviations),
        "iso230_positions": tables.iso230_position_table(deviations, results),
    }
    if with_fields:
        if not has_product(folder, "fields.nc"):
            raise controls.ExportError(
                f"{folder}: there is no fields.nc in it, so that no fields.csv can be written; leave --fields out"
            )
        frames["fields"] = tables.fields_table(folder)
    return frames


def _write(out: Path, content: dict[str, Writer], *, overwrite: bool) -> tuple[Path, ...]:
    """Write files, or none where one of them exists and may not be replaced."""
    if out.exists() and not out.is_dir():
        raise controls.ExportError(f"{out} is a file; name a folder with --out")
    paths = {out / name: write for name, write in content.items()}
    there = [path.name for path in paths if path.exists()]
    if there and not overwrite:
        raise controls.ExportError(
            f"{out}: {', '.join(there)} exists already; add --overwrite to replace it, or name another folder with --out"
        )
    return tuple(write_atomically(path, write) for path, write in paths.items())


# Pictures of the table's temperature: every cycle as PNG beside a contact sheet, or all cycles as a film.

#: What a picture shows of a cycle, one below the other.
_PICTURED = ("temperature", "temperature_rise")
#: Width of a picture, inches, and its resolution, px per inch.
_WIDTH, _DPI = 8.0, 120
#: Length at which a film goes through all cycles, s, between its slowest and fastest rate, 1/s.
_FILM_S, _SLOWEST_HZ, _FASTEST_HZ = 20.0, 2.0, 25.0


def draw_maps(
    fields: xr.Dataset, hotspots: Sequence[HotspotPart], title: str, format: str
) -> dict[str, Callable[[Path], object]]:
    """Return what writes the pictures of all cycles by the name of their file."""
    drawing = CyclePictures(fields, hotspots, title)
    cycles = [int(cycle) for cycle in fields["cycle"].values]
    if format == "png":
        written: dict[str, Callable[[Path], object]] = {
            "contact_sheet.png": partial(_write_contact_sheet, fields=fields, title=title)
        }
        digits = max(4, len(str(cycles[-1])))
        return written | {
            f"cycle_{cycle:0{digits}d}.png": partial(_write_png, drawing=drawing, cycle=cycle) for cycle in cycles
        }
    rate_Hz = float(np.clip(len(cycles) / _FILM_S, _SLOWEST_HZ, _FASTEST_HZ))
    write = {"gif": write_gif, "mp4": write_mp4}[format]
    return {f"cycles.{format}": lambda path: write(path, map(drawing.draw, cycles), rate_Hz=rate_Hz)}


class CyclePictures:
    """Temperature and rise of the table in one cycle after the other, each on the scale of all cycles, in one figure that is kept."""

    def __init__(self, fields: xr.Dataset, hotspots: Sequence[HotspotPart], title: str) -> None:
        self._fields, self._title = fields, title
        first = int(fields["cycle"].values[0])
        height = min(2.0 * (0.8 * _WIDTH * _height_of(fields) + 0.9), 2.0 * _WIDTH)
        figure = Figure(figsize=(_WIDTH, height), dpi=_DPI, layout="constrained")
        self._canvas = FigureCanvasAgg(figure)
        self._axes = [
            plot_field(fields, ax, cycle=first, quantity=name)
            for ax, name in zip(figure.subplots(2), _PICTURED, strict=True)
        ]
        self._marks = [(spot, _mark(ax, spot)) for ax in self._axes for spot in hotspots]
        self._axes[1].set_title(
            f"rise since cycle {first}, {moment(fields['cycle_time'].values[0])}", fontsize="medium"
        )

    def draw(self, cycle: int) -> NDArray[np.uint8]:
        """Return the picture of a cycle, (row, column, 3), red, green and blue."""
        field = self._fields.sel(cycle=cycle)
        for ax, name in zip(self._axes, _PICTURED, strict=True):
            ax.images[0].set_data(field[name].values)
        for spot, artists in self._marks:
            shown = (spot.onset_cycle or cycle) <= cycle <= (spot.end_cycle or cycle)
            for artist in artists:
                artist.set_visible(shown)
        self._axes[0].set_title(f"{self._title}\n{_when(field, cycle)}", fontsize="medium")
        self._canvas.draw()
        self._canvas.figure.set_layout_engine("none")  # the first picture has set the places of all
        drawn = np.asarray(self._canvas.buffer_rgba())[..., :3]
        return np.ascontiguousarray(
            drawn[: drawn.shape[0] // 2 * 2, : drawn.shape[1] // 2 * 2]
        )  # even, as a film needs it


def _when(field: xr.Dataset, cycle: int) -> str:
    return f"cycle {cycle}, {moment(field['cycle_time'].values.astype(str).item())}"


def _height_of(fields: xr.Dataset) -> float:
    """Return the height of the plan over its width."""
    return fields.sizes["y"] / fields.sizes["x"]


def _mark(ax: Axes, spot: HotspotPart) -> list[Artist]:
    """Ring a hotspot and write its name."""
    assert spot.x_mm is not None and spot.y_mm is not None
    rings = [
        ax.plot(spot.x_mm, spot.y_mm, "o", ms=11, mfc="none", mec=colour, mew=width, clip_on=False)[0]
        for colour, width in (("black", 3.2), ("white", 1.6))  # dark under light reads on every colour
    ]
    name = ax.annotate(
        spot.name, (spot.x_mm, spot.y_mm), (0, 9), textcoords="offset points", color="white", ha="center", fontsize="small",
        bbox={"facecolor": "black", "alpha": 0.7, "edgecolor": "none", "pad": 1.5},
    )  # fmt: skip
    return [*rings, name]


def _write_png(path: Path, drawing: CyclePictures, cycle: int) -> None:
    Image.fromarray(drawing.draw(cycle)).save(path, format="png")


def _write_contact_sheet(path: Path, fields: xr.Dataset, title: str) -> None:
    """Write the rise in cycles spread over the test, beside each other on one scale."""
    cycles = fields["cycle"].values
    chosen = cycles[cycles_on_sheet(fields)]
    rows = -(-chosen.size // SHEET_COLUMNS)
    figure = Figure(figsize=(11.0, 0.8 + rows * (3.2 * _height_of(fields) + 0.5)), dpi=_DPI, layout="constrained")
    panels = figure.subplots(rows, SHEET_COLUMNS, squeeze=False, sharex=True, sharey=True).ravel()
    scale = field_scale(fields, "temperature_rise")
    for ax, cycle in zip(panels, chosen, strict=False):
        image = draw_field(fields, ax, int(cycle), "temperature_rise", scale)
        ax.set_title(_when(fields.sel(cycle=cycle), cycle), fontsize="small")
        ax.tick_params(labelsize="x-small")
    for ax in panels[chosen.size :]:
        ax.set_axis_off()
    figure.colorbar(image, ax=panels.tolist(), label=f"rise since cycle {cycles[0]} / K")
    figure.suptitle(f"{title}; x and y in mm", fontsize="medium")
    figure.savefig(path, format="png")
