"""A results folder without thermograms: an axis of known profile that stretches with the material temperature."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from fusion.results.results import Notice, assemble
from fusion.results.store import joined, write_dataset, write_json
from interferometry.deviations import build_deviations
from interferometry.drift.estimate import estimate_drift
from interferometry.iso230 import evaluate_iso230, evaluate_windows
from tests.fusion.results_sample import PARTS
from thermography.common import FIELDS

#: Unequal distances, as ISO 230-2 asks for.
UNEVEN_MM = np.array([0.0, 26.0, 48.0, 77.0, 101.0, 124.0, 153.0, 175.0])
STRETCH_PPM_PER_K, SHIFT_UM_PER_K = 8.0, -0.6
CYCLES = 12


def true_profile_um(position_mm: np.ndarray) -> np.ndarray:
    """Mean of both approaches; the approach in positive direction stands 1 um above that in negative direction."""
    return 6.0 * np.sin(position_mm / 60.0) + position_mm / 50.0


def material_degC() -> np.ndarray:
    """Material temperature per cycle: up and down, so that it is no mere trend."""
    return 22.0 + 2.0 * np.sin(np.arange(CYCLES) / 2.0)


def measured(position_mm: np.ndarray = UNEVEN_MM, *, noise_um: float = 0.05, seed: int = 7) -> xr.Dataset:
    """Readings of that axis with noise."""
    rng = np.random.default_rng(seed)
    rise = material_degC() - material_degC().mean()
    thermal = rise[:, None, None] * (SHIFT_UM_PER_K + STRETCH_PPM_PER_K * position_mm * 1e-3)
    profile = true_profile_um(position_mm) + np.array([[0.5], [-0.5]])
    deviation = profile + thermal + noise_um * rng.standard_normal((CYCLES, 2, position_mm.size))
    order = np.concatenate([np.arange(position_mm.size), np.arange(2 * position_mm.size)[: position_mm.size - 1 : -1]])
    seconds = np.arange(CYCLES)[:, None, None] * 300 + 5 * order.reshape(2, -1)
    time = np.datetime64("2026-03-09T06:30:00", "ns") + seconds.astype("timedelta64[s]")
    return build_deviations(range(1, CYCLES + 1), range(1, position_mm.size + 1), position_mm, deviation, time)


def write_run(folder: Path, deviations: xr.Dataset, *, axis: str = "X", **changes: Any) -> Path:
    """Write deviations.nc, fusion.nc, results.json and provenance.json of a run whose verdict is sound unless `changes` say otherwise."""
    parts = {**PARTS, "inputs": {"state": "sound", "accepted": [], "checks": []}, **changes}
    quoted = evaluate_iso230(deviations, cycles=range(6, 11))  # the window that PARTS quotes
    content = joined(deviations, estimate=estimate_drift(deviations), iso=evaluate_windows(deviations), quoted=quoted)
    write_dataset(folder / "deviations.nc", content)
    dims = ("cycle", "direction", "target")
    degC = np.broadcast_to(material_degC()[:, None, None], deviations["deviation"].shape)
    fused = deviations.assign(material_temperature=(dims, degC), air_temperature=(dims, degC - 1.0))
    write_dataset(folder / "fusion.nc", fused)
    title = "=1+1 \n; M30 axis µ"
    write_json(folder / "results.json", assemble(title, parts, [Notice("a", "b", "")]).as_json())
    provenance = {
        "parameters": {"campaign": {"axis": axis}, "report": {"machine": "Mill 5", "machine_serial_number": "77"}}
    }
    provenance["parameters"]["report"]["machine_compensation"] = "none"
    (folder / "provenance.json").write_text(json.dumps(provenance), encoding="utf-8")
    return folder


def write_fields(folder: Path) -> None:
    """Write a fields.nc of 2 cycles and 6 cells, one of which was never seen."""
    seen = np.ones((2, 2, 3), dtype=np.float32)
    seen[:, 0, 0] = np.nan
    moments = np.array(["2026-03-09T06:30", "2026-03-09T06:40"], dtype="datetime64[ns]")
    coordinates = {"cycle": [1, 2], "y": [2.5, 7.5], "x": [2.5, 7.5, 12.5], "time": moments}
    values = {("cycle",): moments, ("y", "x"): seen[0]}
    fields = xr.Dataset(
        {name: (dims, values.get(dims, seen)) for name, (dims, *_) in FIELDS.items()}, coords=coordinates
    )
    write_dataset(folder / "fields.nc", fields)
