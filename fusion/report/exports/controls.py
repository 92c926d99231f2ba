"""Layouts of compensation tables: one function per control, and what each control knows.

Positions are in mm from the machine's zero as the laser file gives them. The value of every layout is the measured deviation, measured
minus programmed, relative to the reference; what the control does with it is stated per layout.

Sources: LinuxCNC, ``src/emc/motion/usrmotintf.cc`` (function ``usrmotLoadComp``); Siemens, SINUMERIK 840D sl Function Manual Extended
Functions, K3; HEIDENHAIN, Technical Manual MANUALplus 620, "Entering compensation values", and TNC 407 (256 entries at most);
Beckhoff, TF5200 axis compensation, ``kw.ssfk`` with its worked example.
"""

from __future__ import annotations

import math
import os
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from fusion.analysis.predicted_test import APPROACHES, in_order
from fusion.common import Array, FusionError
from fusion.report.wording import environment, say, sentences
from fusion.results.loop import RecordLoop
from fusion.results.recursion import LATE_KEPT, LATE_STEPS, Recursion, RecursionInput
from fusion.results.results import Results
from fusion.results.store import (
    file_sha256,
    group,
    has_product,
    read_product,
    read_provenance,
)

# The error of exports.


class ExportError(FusionError):
    """Results that cannot be exported as asked for; the message says why and what to do."""


# The drift-free profile of an axis as a compensation needs it: relative to a reference, at the points of a table,
# with its uncertainty.

_SPACING_TOLERANCE_MM = 1e-3


@dataclass(frozen=True)
class Profile:
    """Positioning deviations (2, n) without drift at the targets in the order of the positions, mm, by positive and negative approach, um,
    with their covariance (2, n, 2, n).
    """

    position_mm: Array
    deviation_um: Array
    covariance_um2: Array


@dataclass(frozen=True)
class ActiveTable:
    """The table that was active during a test: name of its file, its points (m,), increasing, and what it takes for the deviation (2, m) by
    positive and negative approach.
    """

    name: str
    position_mm: Array
    deviation_um: Array

    def at(self, position_mm: Array) -> Array:
        """Return what it takes for the deviation (2, n), on straight lines, held beyond its ends as controls hold it."""
        return _on_lines(position_mm, self.position_mm, self.deviation_um)


@dataclass(frozen=True)
class ErrorTable:
    """What a compensation table corrects: deviations at its points, relative to the reference position.

    Attributes
    ----------
    position_mm : (m,), points of the table, increasing
    deviation_um : (2, m) ndarray
        Approach in positive and in negative direction; zero at the reference position approached in positive direction, but for what an
        active table holds there.
    u_um : (2, m), standard uncertainty, that of the interpolation included
    reference_mm : position at which the correction, or what is added to an active table, is zero
    widest_gap_mm : largest distance of two neighbouring targets
    resampled : whether the points are others than the targets
    active : the table that was active during the test, which this one contains and replaces
    """

    position_mm: Array
    deviation_um: Array
    u_um: Array
    reference_mm: float
    widest_gap_mm: float
    resampled: bool = False
    active: ActiveTable | None = None

    def spacing_mm(self) -> float | None:
        """Return the distance of the points; None where they are not equally spaced."""
        steps = np.diff(self.position_mm)
        return float(steps.mean()) if np.ptp(steps) <= _SPACING_TOLERANCE_MM else None

    def mean_um(self) -> Array:
        """Return the mean of both approaches (m,) for a control that knows one table; what is added is zero at the reference."""
        added = self.added_um(np.array([self.reference_mm]), one_table=False).mean()
        return self.deviation_um.mean(axis=0) - added

    def reversal_um(self) -> float:
        """Return the mean reversal error (positive minus negative approach), less what an active table takes out."""
        added = self.added_um(self.position_mm, one_table=False)
        return float((added[0] - added[1]).mean())

    def added_um(self, position_mm: Array, *, one_table: bool) -> Array:
        """Return what the table takes out of the deviations (2, n) beyond an active one; of one table, the mean reversal is added."""
        added = _on_lines(position_mm, self.position_mm, self.deviation_um)
        if self.active is not None:
            added = added - self.active.at(position_mm)
        if not one_table:
            return added
        half = self.reversal_um() / 2.0
        return added.mean(axis=0) + np.array([[half], [-half]])


def _on_lines(at_mm: Array, position_mm: Array, values: Array) -> Array:
    """Return the values (2, m) of both approaches at other positions (2, n), on straight lines."""
    return np.array([np.interp(at_mm, position_mm, one) for one in values])


def read_profile(deviations: xr.Dataset) -> Profile:
    """Return the profile of a run."""
    test = in_order(group(deviations, "estimate").assign(position=deviations["position"]))
    position, deviation = test["position"].values.astype(float), test["profile"].values
    gaps = ~np.isfinite(deviation).all(axis=0)
    if gaps.any():
        raise ExportError(
            f"no profile at {position[gaps][0]:g} mm in one approach; a compensation table needs both: measure it in both directions"
        )
    if position.size < 2:
        raise ExportError("one position only; a compensation table needs at least two")
    return Profile(position, deviation, test["covariance"].values)


def tabulate(
    profile: Profile,
    *,
    spacing_mm: float | None = None,
    reference_mm: float | None = None,
    active: ActiveTable | None = None,
) -> ErrorTable:
    """Return the deviations at the points of a table, relative to the reference, in sum with a table that was active during the test."""
    targets = profile.position_mm
    # Axes are referenced at their zero where they reach it.
    reference = float(np.clip(0.0, targets[0], targets[-1])) if reference_mm is None else reference_mm
    if not targets[0] <= reference <= targets[-1]:
        raise ExportError(
            f"the reference {reference:g} mm is outside the measured {targets[0]:g} to {targets[-1]:g} mm; "
            "name a position between them with --reference"
        )
    points = targets if active is None else np.union1d(targets, active.position_mm)
    points = points if spacing_mm is None else _grid(points, spacing_mm)
    # Beyond the targets nothing is known: what the ends show is held.
    inside = np.clip(points, targets[0], targets[-1])
    weights = _weights(targets, inside)
    # Of the table itself, not of the profile: where the axis is referenced, nothing may jump.
    at_reference = (_weights(points, np.array([reference])) @ weights)[0]
    deviation = profile.deviation_um @ weights.T - profile.deviation_um[0] @ at_reference
    _, since, until = _segments(targets, inside)
    # The variance between the targets.
    bridge = path_variance(profile) * np.abs(since * until) / (since + until)
    return ErrorTable(
        points,
        deviation if active is None else deviation + active.at(points),
        np.sqrt(_relative_variance(profile, weights, at_reference) + bridge),
        reference,
        float(np.diff(targets).max()),
        resampled=spacing_mm is not None,
        active=active,
    )


def path_variance(profile: Profile) -> float:
    """Return the variance per mm of the profile between its targets, from the errors of predicting each target by its two neighbours."""
    targets = profile.position_mm
    estimates = []
    for i in range(1, targets.size - 1):
        before, after = targets[i] - targets[i - 1], targets[i + 1] - targets[i]
        contrast = np.zeros(targets.size)
        contrast[i - 1 : i + 2] = -after / (before + after), 1.0, -before / (before + after)
        for approach in range(len(APPROACHES)):
            noise = contrast @ profile.covariance_um2[approach, :, approach] @ contrast
            error = profile.deviation_um[approach] @ contrast
            estimates.append((error**2 - noise) * (before + after) / (before * after))
    return max(0.0, float(np.mean(estimates))) if estimates else 0.0


#: Points of a resampled table at most: those of 10 m every millimetre.
_MOST_POINTS = 10_000


def _grid(targets: Array, spacing_mm: float) -> Array:
    """Return equally spaced points from the first target to the last, so far apart at most."""
    length = float(targets[-1] - targets[0])
    if not 0.0 < spacing_mm <= length:
        raise ExportError(
            f"--spacing {spacing_mm:g} mm does not suit targets from {targets[0]:g} to {targets[-1]:g} mm; "
            f"write a spacing above 0 and up to {length:g} mm"
        )
    if length / spacing_mm > _MOST_POINTS:
        raise ExportError(
            f"--spacing {spacing_mm:g} mm: more than {_MOST_POINTS} points from {targets[0]:g} to {targets[-1]:g} mm, more than a control "
            f"reads; write {1.001 * length / _MOST_POINTS:.3g} mm or more"
        )
    return np.asarray(np.linspace(targets[0], targets[-1], math.ceil(length / spacing_mm - 1e-9) + 1), float)


def _segments(targets: Array, points: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Return the target before each point, the distance from it, and the distance to the target behind."""
    before = np.clip(np.searchsorted(targets, points, side="right") - 1, 0, targets.size - 2)
    return before, points - targets[before], targets[before + 1] - points


def _weights(targets: Array, points: Array) -> Array:
    """Return the weights (m, n) by which deviations at the targets are interpolated at the points."""
    before, since, until = _segments(targets, points)
    rows = np.arange(points.size)
    weights = np.zeros((points.size, targets.size))
    weights[rows, before] = until / (since + until)
    weights[rows, before + 1] = since / (since + until)
    return weights


def _relative_variance(profile: Profile, weights: Array, at_reference: Array) -> Array:
    """Return the variance (2, m) of the interpolated deviations less the one at the reference, um2."""
    variances = []
    for approach in range(len(APPROACHES)):
        contrast = np.zeros((weights.shape[0], *profile.deviation_um.shape))
        contrast[:, approach] += weights
        contrast[:, 0] -= at_reference
        flat = contrast.reshape(weights.shape[0], -1)
        covariance = profile.covariance_um2.reshape(flat.shape[1], flat.shape[1])
        variances.append(np.einsum("mi,ij,mj->m", flat, covariance, flat))
    return np.maximum(np.array(variances), 0.0)


@dataclass(frozen=True)
class Control:
    """A control, or a program that loads tables into controls.

    Attributes
    ----------
    words : its name
    write : returns the table's text from the error table, the axis name and the lines of its header
    file_name : name of the file; ``{axis}`` is replaced by the axis
    sign : sign convention, a sentence
    comment : what begins a comment; empty where its dialect has none, so that the header goes into a file of its own
    loading : what the control needs besides the file, a sentence
    read : returns the points (m,), mm, and deviations (2, m), mm, of a table's text; a ValueError says why it is none
    most_points : maximum number of points
    equal_spacing : whether the points must be equally spaced
    names_axis : whether the axis is named in the table
    one_table : whether it knows one table for both approaches
    """

    words: str
    write: Callable[[ErrorTable, str, Sequence[str]], str]
    file_name: str
    sign: str
    loading: str
    read: Callable[[str], tuple[Array, Array]]
    comment: str = ""
    most_points: int | None = None
    equal_spacing: bool = False
    names_axis: bool = True
    one_table: bool = False


def linuxcnc(table: ErrorTable, axis: str, header: Sequence[str]) -> str:
    """Return a COMP_FILE of type 0: triplets of nominal, and true position by the forward and by the reverse approach, in mm."""
    rows = [f"{at:.6f} {at + forward:.6f} {at + reverse:.6f}" for at, forward, reverse in _rows_mm(table)]
    return "\n".join(rows) + "\n"


def read_linuxcnc(text: str) -> tuple[Array, Array]:
    """Read a COMP_FILE of type 0 up to the first line that is no triplet, as the control does."""
    rows: list[list[float]] = []
    for line in text.splitlines():
        try:
            rows.append([float(word) for word in line.split()[:3]])
        except ValueError:
            break
        if len(rows[-1]) < 3:
            rows.pop()
            break
    if not rows:
        raise ValueError("its first line holds no three numbers")
    at, forward, reverse = np.array(rows).T
    # Type 1 holds corrections, which are small, in place of positions.
    if np.abs(forward - at).max() > np.abs(forward).max():
        raise ValueError(
            "it is of COMP_FILE_TYPE 1; write position, position - correction forward and backward (type 0)"
        )
    return at, np.array([forward - at, reverse - at])


def siemens840d(table: ErrorTable, axis: str, header: Sequence[str]) -> str:
    """Return an $AA_ENC_COMP archive in mm: the mean of both approaches; the mean reversal belongs to the backlash."""
    mean_mm = (table.mean_um() * 1e-3).tolist()
    area = axis if re.fullmatch(r"AX\d+", axis) else "AX"
    lines = [
        f"%_N_{area}_EEC_INI",
        *(f"; {line}" for line in header),
        f"; the mean reversal error belongs into MD32450 $MA_BACKLASH: {-table.reversal_um() * 1e-3:+.6f} mm on top of the value that was "
        "active (positive: the encoder leads the machine part)",
        "CHANDATA(1)",
        f"$AA_ENC_COMP_STEP[0,{axis}]={np.diff(table.position_mm).mean():.6f}",
        f"$AA_ENC_COMP_MIN[0,{axis}]={table.position_mm[0]:.4f}",
        f"$AA_ENC_COMP_MAX[0,{axis}]={table.position_mm[-1]:.4f}",
        f"$AA_ENC_COMP_IS_MODULO[0,{axis}]=0",
        *(f"$AA_ENC_COMP[0,{at},{axis}]={value:.6f}" for at, value in enumerate(mean_mm)),
        "M17",
    ]
    return "\n".join(lines) + "\n"


def read_siemens840d(text: str) -> tuple[Array, Array]:
    """Read $AA_ENC_COMP of one axis, the same for both approaches; the backlash is no part of it."""
    values = {
        int(at): float(value) for at, value in re.findall(r"^\$AA_ENC_COMP\[\d+,(\d+),\w+\]\s*=\s*(\S+)", text, re.M)
    }
    step, low = (re.search(rf"^\$AA_ENC_COMP_{name}\[[^]]*\]\s*=\s*(\S+)", text, re.M) for name in ("STEP", "MIN"))
    if not values or step is None or low is None:
        raise ValueError("it holds no $AA_ENC_COMP with $AA_ENC_COMP_STEP and $AA_ENC_COMP_MIN")
    at = np.asarray(float(low[1]) + float(step[1]) * np.arange(max(values) + 1), float)
    # What is not written is zero in the control.
    one = np.array([values.get(k, 0.0) for k in range(at.size)])
    return at, np.array([one, one])


def heidenhain(table: ErrorTable, axis: str, header: Sequence[str]) -> str:
    """Return a table AXIS_<axis>.COM: position, and deviation (mm) by the negative (BACKLASH) and by the positive approach."""
    head = f"{'NR':<6}{'AXISPOS':<14}{'BACKLASH':<14}{axis}"
    rows = [
        f"{number:<6}{at:<+14.4f}{reverse:<+14.6f}{forward:+.6f}"
        for number, (at, forward, reverse) in enumerate(_rows_mm(table))
    ]
    return "\n".join([f"BEGIN AXIS_{axis}.COM MM", head, *rows, "[END]"]) + "\n"


def read_heidenhain(text: str) -> tuple[Array, Array]:
    """Read a table with AXISPOS and BACKLASH: the column of the axis forwards, BACKLASH backwards."""
    lines = [line.split() for line in text.splitlines() if line.strip()]
    head = next((line for line in lines if "AXISPOS" in line), [])
    axis = [k for k, name in enumerate(head) if name not in ("NR", "AXISPOS", "BACKLASH")]
    if len(axis) != 1 or "BACKLASH" not in head:
        raise ValueError("it has no line NR AXISPOS BACKLASH and one axis")
    rows = [line for line in lines[lines.index(head) + 1 :] if len(line) == len(head)]
    table = np.array([[float(word) for word in line] for line in rows]).reshape(-1, len(head)).T
    return table[head.index("AXISPOS")], table[[axis[0], head.index("BACKLASH")]]


def twincat(table: ErrorTable, axis: str, header: Sequence[str]) -> str:
    """Return a list of leadscrew error compensation: both approaches at points of any distance, in 0.1 um."""
    at, forward, reverse = np.rint(1e4 * np.array(_rows_mm(table)).T).astype(int).tolist()
    places = {"setpoint": at, "pos": forward, "neg": reverse}
    lines = [
        "kopf.achs_nr 0",
        f"kopf.log_achs_name {axis}",
        "kw.ssfk.interval 0",
        f"kw.ssfk.kw_startpos {at[0]}",
        f"kw.ssfk.kw_nr_max {len(at)}",
        "kw.ssfk.unit 1",
        "kw.ssfk.bilateral 1",
        *(f"kw.ssfk.table[{k}].{name} {one}" for name, values in places.items() for k, one in enumerate(values)),
    ]
    return "\n".join(lines) + "\n"


def read_twincat(text: str) -> tuple[Array, Array]:
    """Read a list of leadscrew error compensation in 0.1 um, of which a table for one direction is the same for both."""
    found = {name: float(value) for name, value in re.findall(r"^kw\.ssfk\.(\S+)\s+(-?\d+)", text, re.M)}
    count, step = int(found.get("kw_nr_max", 0)), found.get("interval", 0.0)
    if found.get("unit") != 1.0 or not count:
        raise ValueError("it holds no kw.ssfk.kw_nr_max, or kw.ssfk.unit is not 1 (0.1 um)")
    start = found.get("kw_startpos", 0.0)
    at = [start + step * k if step else found.get(f"table[{k}].setpoint", math.nan) for k in range(count)]
    both = ("pos", "neg") if found.get("bilateral") else ("pos", "pos")
    values = [[found.get(f"table[{k}].{name}", 0.0) for k in range(count)] for name in both]
    return 1e-4 * np.array(at), 1e-4 * np.array(values)


#: Controls by the name of their format.
CONTROLS = {
    "linuxcnc": Control(
        "LinuxCNC, COMP_FILE_TYPE 0",
        linuxcnc,
        "compensation_{axis}.comp",
        "columns are the programmed position and the position really reached by the forward and by the reverse approach; the control "
        "subtracts really reached minus programmed from the command",
        "[JOINT_n] of the ini file names it as COMP_FILE with COMP_FILE_TYPE = 0",
        read_linuxcnc,
        most_points=256,
        names_axis=False,
    ),
    "siemens840d": Control(
        "Siemens SINUMERIK 840D, $AA_ENC_COMP",
        siemens840d,
        "compensation_{axis}.MPF",
        "a value is the measured deviation and is added to the actual position, so that a positive value moves the axis in negative "
        "direction",
        "the axis is the machine axis (MD10000, such as X1); index 0 is its first measuring system, an axis on its second one (as often a "
        "linear scale) needs 1 in place of 0; MD38000 $MA_MM_ENC_COMP_MAX_POINTS has to allow all points before; the table can be loaded "
        "while MD32700 $MA_ENC_COMP_ENABLE is 0",
        read_siemens840d,
        comment=";",
        equal_spacing=True,
        one_table=True,
    ),
    "heidenhain": Control(
        "HEIDENHAIN, axis-error compensation AXIS_<axis>.COM with AXISPOS and BACKLASH",
        heidenhain,
        "AXIS_{axis}.COM",
        "a value is the measured deviation, in the column of the axis by the positive approach and in BACKLASH by the negative approach",
        "the control uses it where its table of active corrections (.CMA) names it for the axis; columns are those of the MANUALplus 620, "
        "controls up to the iTNC 530 expect others (DATUM, DISTANCE)",
        read_heidenhain,
        most_points=256,
    ),
    "twincat": Control(
        "Beckhoff TwinCAT CNC (TF5200, ISG kernel), leadscrew error compensation kw.ssfk",
        twincat,
        "achskw_{axis}.lis",
        "a value is actual position minus set position in 0.1 um: pos of the positive approach, neg of the negative one",
        "kopf.achs_nr has to be the logical number of the axis in place of 0; P-AXIS-00175 (lr_param.ssfk) switches it on",
        read_twincat,
        most_points=1500,
    ),
}  # fmt: skip


def _rows_mm(table: ErrorTable) -> list[tuple[float, float, float]]:
    """Return position and deviation by the forward and the reverse approach, mm, as plain numbers."""
    forward, reverse = (table.deviation_um * 1e-3).tolist()
    return list(zip(table.position_mm.tolist(), forward, reverse, strict=True))


# The thermal state that a profile belongs to: when it was measured, and how warm material and air were.


@dataclass(frozen=True)
class ThermalState:
    """When and how warm.

    Attributes
    ----------
    first, last : time of the first and the last reading, UTC; None where the file has no times
    cycles : number of the first and the last cycle
    temperatures_degC : dict of str to (mean, lowest, highest) or None
        Of material and air at the readings, the mean over cycles of equal weight, as for the profile; None where it was not logged.
    """

    first: np.datetime64 | None
    last: np.datetime64 | None
    cycles: tuple[int, int]
    temperatures_degC: dict[str, tuple[float, float, float] | None]


def read_thermal_state(folder: Path, deviations: xr.Dataset) -> ThermalState:
    """Return the thermal state of a run."""
    times, cycles = deviations["time"].values, deviations["cycle"].values
    timed = times[~np.isnat(times)]
    there = has_product(folder, "fusion.nc")
    fused: Mapping[Any, xr.DataArray] = read_product(folder, "fusion") if there else {}
    found: dict[str, tuple[float, float, float] | None] = {}
    for name in ("material", "air"):
        values = fused.get(f"{name}_temperature")
        if values is None or not bool(values.notnull().any()):
            found[name] = None
            continue
        mean = float(values.mean(["direction", "target"]).mean())
        found[name] = (mean, float(values.min()), float(values.max()))
    first, last = (timed.min(), timed.max()) if timed.size else (None, None)
    return ThermalState(first, last, (int(cycles.min()), int(cycles.max())), found)


# The header of a compensation table: where it comes from, in which thermal state it holds, what it is predicted to
# do, how to try it.


@dataclass(frozen=True)
class Origin:
    """The run that a table was made from; texts that its campaign file does not state are empty.

    Attributes
    ----------
    active : the compensation during the test
    campaign_file : the campaign file as seen from the results folder; empty where it is not noted
    verdict : verdict of the closed loop
    """

    campaign: str
    machine: str
    axis: str
    active: str
    verdict: str
    state: ThermalState
    results_sha256: str
    campaign_file: str = ""


def read_origin(folder: Path, results: Results, state: ThermalState) -> Origin:
    """Return where a table comes from."""
    provenance = read_provenance(folder)
    stated = provenance.get("parameters", {})
    report = stated.get("report", {})
    serial = report.get("machine_serial_number")
    return Origin(
        campaign=results.campaign,
        machine=", serial number ".join(str(part) for part in (report.get("machine"), serial) if part),
        active=str(report.get("machine_compensation") or ""),
        axis=str(stated.get("campaign", {}).get("axis") or ""),
        verdict=say("verdict_word", results.loop) if results.loop is not None else "",
        state=state,
        results_sha256=file_sha256(folder / "results.json"),
        campaign_file=str(provenance.get("campaign_file") or ""),
    )


#: What a campaign states where no table was active.
_NOT_ACTIVE = ("none", "no", "off", "inactive", "not active")


def read_active(
    folder: Path, control: Control, origin: Origin, given: str | None
) -> tuple[ActiveTable | None, list[str]]:
    """Return the table that was active during a test, and why it is not known.

    `given` is "none", or the file in the format of the control; None: what the campaign states, of which a file lies beside it.
    """
    stated = (origin.active if given is None else given).strip()
    if stated.casefold() in _NOT_ACTIVE:
        return None, []
    beside = (folder / origin.campaign_file).parent / stated if origin.campaign_file else None
    path = Path(stated) if given is not None else beside
    if not stated or path is None or not os.path.isfile(path):  # noqa: PTH113 - words are too long a name for a file
        if given is not None:
            raise ExportError(
                f'--active: there is no file {stated}; name the table that was active during the test, or write "none"'
            )
        said = f'[report] machine_compensation is "{stated}"' if stated else "the campaign does not say it"
        return None, [
            f"it is not known whether a table was active during the test ({said}): add --active none, or --active FILE with the table that "
            f"was active, in the format of {control.words}, to which what was measured is added"
        ]
    try:
        position, deviation = control.read(path.read_text(encoding="utf-8"))
        if position.size < 2 or not (np.isfinite(deviation).all() and (np.diff(position) > 0.0).all()):
            raise ValueError("it needs two points or more, positions that increase, and numbers")
    except (OSError, ValueError) as reason:
        raise ExportError(
            f"{path}: is no table of {control.words} ({reason}); name the table as the control reads it"
        ) from None
    return ActiveTable(path.name, position, deviation * 1e3), []


def header_lines(origin: Origin, **facts: Any) -> list[str]:
    """Return the header of a table as lines of ASCII text, from the facts that ``templates/compensation_header.j2`` states."""
    # A text from a file must not end its line: a control would run what follows.
    made = environment(html=False).overlay(finalize=lambda value: one_line(value) if isinstance(value, str) else value)
    text = made.get_template("compensation_header.j2").render(origin=origin, **{"exported": datetime.now(UTC), **facts})
    return [one_line(line) for line in text.splitlines() if line]


def one_line(text: str) -> str:
    """Return a text without line breaks and control characters, in ASCII: it may come from a file, and controls read no UTF-8."""
    plain = "".join(letter if letter.isprintable() else " " for letter in text)
    for found, written in (("µ", "u"), ("μ", "u"), ("−", "-"), ("–", "-"), ("±", "+-"), ("°C", "degC")):
        plain = plain.replace(found, written)
    return plain.encode("ascii", "replace").decode("ascii")


# Error line of an axis that moves with the material temperature: offset and gradient per kelvin, for controls that
# follow a sensor.


_BLOCKS = 5
#: Error probability of a coefficient that is taken for more than chance.
_LEVEL = 0.01
#: Cycles that a block needs at least.
_CYCLES_PER_BLOCK = 2


@dataclass(frozen=True)
class TemperatureLine:
    """Drift per kelvin of the material temperature: ``(offset + gradient (P - P0)) (T - T0)``.

    Attributes
    ----------
    offset_um_per_K, gradient_ppm_per_K : shift and stretch per kelvin
    offset_u_um_per_K, gradient_u_ppm_per_K : standard uncertainty by the jackknife over blocks of cycles
    reference_mm : P0
    mean_degC : T0, at which the profile holds
    range_degC : lowest and highest temperature of the test
    before_um, after_um : float
        Root mean square of the readings less the profile, and of the error of predicting each block of cycles from the others.
    """

    offset_um_per_K: float
    gradient_ppm_per_K: float
    offset_u_um_per_K: float
    gradient_u_ppm_per_K: float
    reference_mm: float
    mean_degC: float
    range_degC: tuple[float, float]
    before_um: float
    after_um: float

    def objections(self) -> list[str]:
        """Return why the line should not be used; empty where it predicts, by coefficients that are no chance."""
        if self.after_um >= self.before_um:
            return [
                "the material temperature does not predict the drift: the error of predicting each block of cycles from the others is "
                f"{self.after_um:.3g} um with the line and {self.before_um:.3g} um without it"
            ]
        limit = float(special.stdtrit(_BLOCKS - 1, 1.0 - _LEVEL / 2.0))
        of_shift, of_stretch = limit * self.offset_u_um_per_K, limit * self.gradient_u_ppm_per_K
        if abs(self.offset_um_per_K) > of_shift or abs(self.gradient_ppm_per_K) > of_stretch:
            return []
        return [f"neither shift nor stretch per kelvin exceeds {limit:.1f} standard uncertainties: they may be chance"]


def fit_temperature_line(
    deviations: xr.Dataset, material_degC: xr.DataArray, *, reference_mm: float
) -> TemperatureLine:
    """Fit shift and stretch of the axis per kelvin of the material temperature."""
    cycles = deviations.sizes["cycle"]
    if cycles < _BLOCKS * _CYCLES_PER_BLOCK:
        raise ExportError(
            f"{cycles} cycles; a temperature line needs at least {_BLOCKS * _CYCLES_PER_BLOCK}, to be judged on cycles left out of it"
        )
    drift = deviations["deviation"] - group(deviations, "estimate")["profile"]
    position = deviations["position"] - reference_mm
    _, distance, temperature = xr.broadcast(drift, position, material_degC.reindex_like(drift))
    dims = drift.dims
    y, distance_mm, degC = (array.transpose(*dims).values for array in (drift, distance, temperature))
    block = np.broadcast_to((np.arange(cycles) * _BLOCKS // cycles)[:, None, None], y.shape)
    used = np.isfinite(y) & np.isfinite(degC)
    mean = float(np.mean(degC[used])) if used.any() else np.nan
    if not used.any() or np.ptp(degC[used]) <= 0.0:
        raise ExportError(
            "the material temperature did not change during the test; a temperature line cannot be fitted"
        )
    rise = degC[used] - mean
    columns = np.stack([rise, rise * distance_mm[used] * 1e-3], axis=1)
    readings, blocks = y[used], block[used]
    fits, errors = _leave_blocks_out(columns, readings, blocks)
    offset, gradient = np.linalg.lstsq(columns, readings, rcond=None)[0]
    left_out = fits - fits.mean(axis=0)
    offset_u, gradient_u = np.sqrt((_BLOCKS - 1) / _BLOCKS * np.sum(left_out**2, axis=0))
    return TemperatureLine(
        offset_um_per_K=float(offset),
        gradient_ppm_per_K=float(gradient),
        offset_u_um_per_K=float(offset_u),
        gradient_u_ppm_per_K=float(gradient_u),
        reference_mm=reference_mm,
        mean_degC=mean,
        range_degC=(float(degC[used].min()), float(degC[used].max())),
        before_um=float(np.sqrt(np.mean(readings**2))),
        after_um=float(np.sqrt(np.mean(errors**2))),
    )


def _leave_blocks_out(columns: Array, readings: Array, blocks: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return the coefficients without each block (blocks, 2), and the errors of predicting each block from the others (n,)."""
    fits, errors = [], np.empty_like(readings)
    for number in range(_BLOCKS):
        inside = blocks == number
        coefficients = np.linalg.lstsq(columns[~inside], readings[~inside], rcond=None)[0]
        errors[inside] = readings[inside] - columns[inside] @ coefficients
        fits.append(coefficients)
    return np.array(fits), errors


def siemens_temperature(line: TemperatureLine, axis: str, header: Sequence[str]) -> str:
    """Return setting data of the 840D's temperature compensation: values at the mean temperature, and what to set at others."""
    offset_mm, gradient = line.offset_um_per_K * 1e-3, line.gradient_ppm_per_K * 1e-6
    low, high = line.range_degC
    states = np.arange(np.floor(low), np.ceil(high) + 0.5)
    rows = [
        f"; {degC:10.1f} {offset_mm * (degC - line.mean_degC):+21.6f} {gradient * (degC - line.mean_degC):+17.9f}"
        for degC in states.tolist()
    ]
    lines = [
        *(f"; {text}" for text in header),
        "; MD32750 $MA_TEMP_COMP_TYPE = 3 (bits 0 and 1) switches both parts on; the PLC or a synchronised action sets, at the",
        "; temperature T of the sensor that was logged as material temperature:",
        f"; $SA_TEMP_COMP_ABS_VALUE[{axis}] = {offset_mm:+.9f} mm/K * (T - {line.mean_degC:.2f} degC)",
        f"; $SA_TEMP_COMP_SLOPE[{axis}] = {gradient:+.12f} 1/K * (T - {line.mean_degC:.2f} degC)",
        ";   T / degC  TEMP_COMP_ABS_VALUE / mm  TEMP_COMP_SLOPE",
        *rows,
        f"; at the mean temperature {line.mean_degC:.2f} degC:",
        "CHANDATA(1)",
        f"$SA_TEMP_COMP_REF_POSITION[{axis}]={line.reference_mm:.4f}",
        f"$SA_TEMP_COMP_ABS_VALUE[{axis}]=0.000000",
        f"$SA_TEMP_COMP_SLOPE[{axis}]=0.000000000",
        "M17",
    ]
    return "\n".join(lines) + "\n"


# A drift model for a control: one description, written as JSON, C, Structured Text (IEC 61131-3), or a HAL component of LinuxCNC.

#: Formats of a drift model: template and file name.
MODELS = {
    "model-json": ("", "model.json"),
    "model-c": ("recursion.h.j2", "thermofuse.h"),
    "model-st": ("recursion.st.j2", "thermofuse.st"),
    "model-linuxcnc": ("recursion_hal.py.j2", "thermofuse_hal.py"),
}
_PREFIX = "thermofuse"


def objections_to_model(results: Results) -> list[str]:
    """Return why a control should not run the model of a run."""
    faults = results.loop.sensor_faults if isinstance(results.loop, RecordLoop) else ()
    return sentences("objections_to_model", results, [one for one in faults if one.state == "suspected"])


def emit(model: Recursion, format: str) -> tuple[str, str]:
    """Return file name and text of a model in one of the formats."""
    if any(not one.u > 0.0 for one in model.outputs):
        raise ExportError("the uncertainty of a correction is not known; no model is written without it")
    template, file = MODELS[format]
    if not template:
        return file, model.model_dump_json(indent=1) + "\n"
    made = environment(html=False)
    made.filters["plain"] = _plain
    columns = {name: [getattr(one, name) for one in model.inputs] for name in RecursionInput.model_fields}
    arrays = {name: columns[name] for name in ("reference", "low", "high", "failed_below", "failed_above")}
    for name in ("input", "size", "exponent", "decay", "now", "before", "start", "time_constant_s"):
        arrays[name] = [getattr(one, name) for one in model.states]
    arrays["load"] = [int(one) for one in model.loads]
    for name in ("limit", "max_step"):
        arrays[name] = [getattr(one, name) for one in model.outputs]
    text = made.get_template(template).render(
        model=model,
        prefix=_PREFIX,
        sampling=_number(model.sampling_s),
        header=[_plain(line) for line in sentences("model_header", model)],
        arrays={name: [_number(one) for one in values] for name, values in arrays.items()},
        whole=("input", "exponent", "load"),
        # States are those of this model only.
        made_for=zlib.crc32(model.model_dump_json().encode()) >> 1,
        settling=f"{model.settling_steps * model.sampling_s / 3600.0:.2g}",
        late_kept=_number(LATE_KEPT),
        late_s=_number(LATE_STEPS * model.sampling_s),
        coefficients=[[_number(value) for value in one.coefficients] for one in model.outputs],
    )
    return file, text


def _number(value: float) -> str:
    """Return a number as C, Structured Text and Python read it, without loss; a place or an exponent as an integer."""
    text = repr(value)
    # IEC 61131-3 asks for a decimal point in front of an exponent.
    return re.sub(r"^(-?\d+)e", r"\1.0e", text)


def _plain(text: str) -> str:
    """Return a text that neither ends its line nor its comment."""
    return re.sub(r"\*(?=[/)])|/(?=\*)|\((?=\*)", " ", one_line(text))
