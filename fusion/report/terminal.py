"""What the terminal shows at the end: the findings of a run, or of one ISO 230-2 evaluation, as a table.

What a file holds, in lines for the terminal: FLIR frames, deviations, or an environment log.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from rich.table import Table

from fusion.attribution.duty_plan import DutyPlanError, Machine, plan_duty, switchings
from fusion.campaign.config import CampaignError
from fusion.campaign.inputs import counted, left_out_notices
from fusion.campaign.quantities import read_quantity
from fusion.products.store import write_atomically
from fusion.report import wording
from fusion.report.wording import moment
from interferometry import iso230
from interferometry.inspection import describe_test
from interferometry.io.readers import read_deviations, read_environment
from thermography.inspection import inspect_file, is_flir_file, thumbnail


def summary_table(results: Mapping[str, Any]) -> Table:
    """Return the findings of a run in some ten lines."""
    table = Table(title=f"{results['campaign']}", title_justify="left", show_header=False, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, text in summary_rows(results):
        table.add_row(name, text)
    return table


def summary_rows(results: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return names and values of the summary."""
    rows: list[tuple[str, str]] = []
    if "registration" in results:
        rows.append(("registration", f"{wording.number(results['registration']['rms_mm'], 2)} mm rms"))
    if "iso230" in results:
        iso = results["iso230"]
        rows += [
            (f"{name} ({iso['window']})", wording.measured(**iso[f"{name}_um"], unit="µm")) for name in ("A", "R", "B")
        ]
    if "drift" in results:
        scatter = [value for values in results["drift"]["scatter_um"].values() for value in values if value is not None]
        rows.append(
            ("scatter per position", f"{min(scatter):.2f} to {max(scatter):.2f} µm, median {np.median(scatter):.2f} µm")
        )
    if "anomalies" in results:
        named = [
            f"position {item['target']} {item['direction']}: {wording.CAUSES[item['cause']][0]} (p {wording.p_value(item['p_value'])})"
            for item in results["anomalies"]
        ]
        rows.append(("anomalies", "\n".join(named) or "none"))
    if "correlation" in results:
        rows.append(("drift and field", _field_text(results["correlation"])))
    if "loop" in results:
        rows += _loop_rows(results["loop"])
    for warning in results["warnings"]:
        rows.append(("warning", warning["message"]))
    return rows


def _field_text(found: Mapping[str, Any]) -> str:
    """Return what the correlation says in one sentence, and which switched load is a cause."""
    source = found["source"]
    place = f"x {source['x_mm']:.0f} mm, y {source['y_mm']:.0f} mm (p {wording.p_value(source['p_value'])})"
    text = {
        "attributable": f"the drift goes with the temperature around {place}",
        "not attributable": f"no part of the field goes with the drift; closest is {place}",
        "not separable": "these data cannot tell: the session is one warm-up",
    }[found["verdict"]]
    causes = [one["name"] for one in found["randomised_duty"] or [] if one["cause"]]
    return f"{text}\ncause by randomised duty: {wording.join(causes)}" if causes else text


def _loop_rows(loop: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [("declared", ", ".join(loop["declared"]) or "nothing")]
    for step in loop["steps"]:
        before, after = (wording.number(step[name], 3) for name in ("rmse_before_um", "rmse_after_um"))
        rows.append(
            ("added", f"{step['effect']} (p {wording.p_value(step['p_value'])}), held-out error {before} -> {after} µm")
        )
    rows.append(
        (
            "held-out error",
            f"{wording.number(loop['rmse_declared_um'], 3)} -> {wording.number(loop['rmse_final_um'], 3)} µm",
        )
    )
    rows.append(("noise floor", f"{wording.number(loop['noise_floor_um'], 3)} µm"))
    rows.append(("verdict", f"{loop['verdict']}: {wording.verdict_headline(loop)}"))
    return rows


def iso230_tables(path: Path, cycles: str | None) -> list[Table]:
    """Evaluate a file by ISO 230-2 and return the axis values and the values per position.

    Raises
    ------
    CampaignError, LaserFormatError
        If the window is not understood or the file cannot be used.
    """
    deviations = read_deviations(path)
    window = None if cycles is None else read_window(cycles, deviations)
    try:
        result = iso230.evaluate_iso230(deviations, cycles=window)
    except ValueError as error:
        raise CampaignError(f"{path}: {error}") from None
    axis = Table(title=f"{path.name}, {result.attrs['window']}", title_justify="left")
    axis.add_column("quantity")
    axis.add_column("value / µm", justify="right")
    axis.add_column("U (k = 2) / µm", justify="right")
    rows: list[tuple[str, str, dict[str, str]]]
    rows = [(name.replace("_", " "), name, {}) for name in (*iso230.QUANTITIES, "mean_reversal")]
    for direction, sign in (("positive", "+"), ("negative", "-")):
        rows += [(f"{name}{sign}", f"{name}_unidirectional", {"direction": direction}) for name in ("E", "R", "A")]
    for label, name, at in rows:
        axis.add_row(
            label, *(f"{float(value):.2f}" for value in (result[name].sel(at), 2 * result[f"{name}_u"].sel(at)))
        )
    return [axis, _position_table(deviations, result)]


def _position_table(deviations: xr.Dataset, result: xr.Dataset) -> Table:
    table = Table(title="per position / µm", title_justify="left")
    for name in ("i", "mm", "mean +", "mean -", "s +", "s -", "B_i", "R_i"):
        table.add_column(name, justify="right")
    for target in result["target"].values:
        row = result.sel(target=target)
        values = [
            *(row["mean_unidirectional"].sel(direction=name) for name in ("positive", "negative")),
            *(row["standard_deviation"].sel(direction=name) for name in ("positive", "negative")),
            row["reversal"],
            row["repeatability_bidirectional"],
        ]
        position = float(deviations["position"].sel(target=target))
        table.add_row(str(target), f"{position:g}", *(f"{float(value):.2f}" for value in values))
    return table


def duty_lines(
    sources: Sequence[str], *, effect: str, drift: str, noise: str, cycle: str, power: float, seed: int
) -> list[str]:
    """Propose a duty schedule and return it as lines: how long, with what power, and when to switch what.

    Raises
    ------
    QuantityError, DutyPlanError
        If a quantity has no unit, a source no time constant, or no schedule is possible.
    """
    named = [_source(text) for text in sources]
    machine = Machine(
        sources=tuple(name for name, _ in named),
        time_constants_s=tuple(seconds for _, seconds in named),
        effect_um=read_quantity(effect, "um"),
        drift_um_per_sqrt_h=read_quantity(drift, "um"),
        noise_um=read_quantity(noise, "um"),
        cycle_s=read_quantity(cycle, "s"),
    )
    proposed = plan_duty(machine, power=power, seed=seed)
    reached = float(proposed["power"].sel(hours=float(proposed["test_hours"])).max())
    enough = (
        ""
        if proposed.attrs["enough"]
        else f"; no test of up to {float(proposed['hours'].max()):g} h reaches {power:.0%}"
    )
    lines = [
        f"test of {float(proposed['test_hours']):g} h, mean dwell {wording.duration(float(proposed['mean_dwell']))}: "
        f"chance to name the weakest source {reached:.0%}{enough}",
        "minute  source  state",
    ]
    return lines + [f"{minute:6.0f}  {name}  {state}" for minute, name, state in switchings(proposed)]


def _source(text: str) -> tuple[str, float]:
    name, found, seconds = text.partition("=")
    if not found or not name.strip():
        raise DutyPlanError(
            f'--source "{text}" is no source; write its name and time constant, for example "spindle=40 min"'
        )
    return name.strip(), read_quantity(seconds, "s")


def read_window(text: str, deviations: xr.Dataset) -> list[int]:
    """Return the cycle numbers of a window such as ``"1-5"`` or ``"3"``.

    Raises
    ------
    CampaignError
        If the text is no window, or names a cycle that was not measured.
    """
    match = re.fullmatch(r"\s*(\d+)(?:\s*-\s*(\d+))?\s*", text)
    if match is None:
        raise CampaignError(f'--cycles "{text}" is not a window of cycles; write for example 1-5')
    first, last = int(match.group(1)), int(match.group(2) or match.group(1))
    measured = deviations["cycle"].values.tolist()
    window = [cycle for cycle in range(first, last + 1) if cycle in measured]
    if len(window) != last - first + 1 or not window:
        raise CampaignError(
            f'--cycles "{text}" asks for cycles that were not measured; there are {measured[0]} to {measured[-1]}'
        )
    return window


def describe_file(path: Path) -> list[str]:
    """Return what a file holds, with warnings for what looks wrong.

    Raises
    ------
    FlirFormatError, LaserFormatError
        If the file is of no kind that is known, or cannot be used.
    """
    if is_flir_file(path):
        return inspect_file(path).lines()
    with path.open("rb") as stream:
        start = stream.read(4096)
    if b"air_temperature" in start and b"deviation_um" not in start:
        return _describe_log(path, read_environment(path))
    return _describe_deviations(path, read_deviations(path))


def write_thumbnail(path: Path, folder: Path) -> Path | None:
    """Write a small picture of a thermal file's first frame as ``<file>.png`` into a folder; None for a file without frames."""
    if not is_flir_file(path):
        return None
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{path.name}.png"
    write_atomically(target, lambda part: part.write_bytes(thumbnail(path)))
    return target


def _describe_deviations(path: Path, deviations: xr.Dataset) -> list[str]:
    time, position = deviations["time"].values, deviations["position"].values
    known = time[~np.isnat(time)]
    found = int(np.isfinite(deviations["deviation"]).sum())
    lines = [
        f"{path}: deviations, {counted(deviations.sizes['cycle'], 'cycle')}, {counted(deviations.sizes['target'], 'target')} "
        f"from {position.min():g} to {position.max():g} mm, {found} of {deviations['deviation'].size} readings",
        f"  deviation {float(deviations['deviation'].min()):.3f} to {float(deviations['deviation'].max()):.3f} um",
    ]
    if known.size:
        lines.append(f"  {moment(known.min())} to {moment(known.max())}, times {deviations['time'].attrs['origin']}")
    else:
        lines.append("  no times: thermofuse run needs one per reading")
    return [*lines, *(f"  {line}" for line in describe_test(deviations)), *_warnings(deviations)]


def _describe_log(path: Path, log: xr.Dataset) -> list[str]:
    lines = [
        f"{path}: environment, {log.sizes['time']} rows, {moment(log['time'].values[0])} to {moment(log['time'].values[-1])}"
    ]
    for name, values in log.data_vars.items():
        lines.append(f"  {name} {float(values.min()):.2f} to {float(values.max()):.2f} {values.attrs['units']}")
    return lines + _warnings(log)


def _warnings(dataset: xr.Dataset) -> list[str]:
    return [f"  warning: {notice.message} {notice.remedy}" for notice in left_out_notices(dataset, "left_out")]
