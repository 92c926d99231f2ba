"""How much the error on a measured record hangs on choices of the method: docs/method/records.md, range over designs.

Every design predicts the same parts of the record, each by its whole procedure from the time before. Errors are root mean squares by
channel, averaged over channels and parts; plain predictions beside them are averaged alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion.analysis.drift_model import record as effects
from fusion.analysis.drift_model import record_data as blocks
from fusion.analysis.drift_model.predictions import channel_rmse, plain_predictions
from fusion.analysis.drift_model.record import chain_forward, declare
from fusion.analysis.drift_model.record_data import Record, reduce_record
from tests.fusion.record_tables import SPINDLE, spindle_table

pytestmark = pytest.mark.slow

#: Choices that could have been made otherwise: module and name -> value. The first is the one that is used.
DESIGNS: dict[str, Mapping[tuple[Any, str], Any]] = {
    "as it is": {},
    "200 blocks": {(blocks, "MOST_BLOCKS"): 200},
    "300 blocks": {(blocks, "MOST_BLOCKS"): 300},
    "1200 blocks": {(blocks, "MOST_BLOCKS"): 1200},
    "chain 1/9 : 1/3 : 1": {(effects, "SOURCE_CHAIN"): (0.0, 1.0 / 9.0, 1.0 / 3.0, 1.0)},
    "chain 1/4 : 1": {(effects, "SOURCE_CHAIN"): (0.0, 0.25, 1.0)},
    "chain 1 : 4": {(effects, "SOURCE_CHAIN"): (0.0, 1.0, 4.0)},
    "one state": {(effects, "SOURCE_CHAIN"): (0.0, 1.0)},
    "two states": {(effects, "SOURCE_CHAIN"): (0.0, 0.5, 2.0)},
    "chain 1/2 : 1 : 2": {(effects, "SOURCE_CHAIN"): (0.0, 0.5, 1.0, 2.0)},
    "time constants from 10 min": {(effects, "_SOURCE_MIN"): (10.0, 30.0, 90.0)},
    "time constants to 160 min": {(effects, "_SOURCE_MIN"): (5.0, 10.0, 20.0, 40.0, 80.0, 160.0)},
}


@pytest.mark.real_data
def test_range_of_the_error_over_designs(
    tmp_path: Path,
    real_file: Callable[[str], Path],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    table = spindle_table(tmp_path, real_file(SPINDLE))
    errors = []
    for name, choices in DESIGNS.items():
        with monkeypatch.context() as patched:
            for (module, constant), value in choices.items():
                patched.setattr(module, constant, value)
            record = reduce_record(table)
            parts = chain_forward(record, declare(["quasi_static"], record))
        before, after = (
            float(np.mean([getattr(part, f"rmse_{which}_um") for part in parts])) for which in ("declared", "final")
        )
        heat = sum("unseen_heat_source" in part.effects for part in parts)
        others = {effect for part in parts for effect in part.effects} - {"unseen_heat_source"}
        errors.append(after)
        with capsys.disabled():
            print(
                f"\n{name}: {before:.2f} -> {after:.2f} um, heat in {heat} of {len(parts)} parts, others {sorted(others)}"
            )
        # Whatever the design: the loop does not make the prediction worse.
        assert after < before
    with capsys.disabled():
        print(f"range {min(errors):.2f} to {max(errors):.2f} um")
        for name, error in _plain(reduce_record(table)).items():
            print(f"{name}: {error:.2f} um")


def _plain(record: Record) -> dict[str, float]:
    """Errors of the plain predictions of the same parts, averaged alike, um."""
    missed: dict[str, list[float]] = {}
    for number in np.unique(record.chained)[2:]:
        before, part = record.chained < number, record.chained == number
        for name, predicted in plain_predictions(record, before).items():
            missed.setdefault(name, []).append(float(np.mean(channel_rmse((record.displacement - predicted)[part]))))
    return {name: float(np.mean(values)) for name, values in missed.items()}
