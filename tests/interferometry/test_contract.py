"""What crosses the border of the package: every source of deviations keeps the contract."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from interferometry.contract import DEVIATIONS
from interferometry.io.readers import read_deviations
from interferometry.io.writers import write_deviations_csv, write_rtl
from tests.interferometry.simulated_campaigns import simulate


def keeps_contract(deviations: xr.Dataset) -> bool:
    return all(
        (deviations[name].dims, deviations[name].attrs.get("units", ""), deviations[name].dtype.kind)
        == (dims, units, kind)
        for name, (dims, units, kind) in DEVIATIONS.items()
    )


def test_built_deviations_keep_the_contract(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=2)
    assert keeps_contract(deviations)
    assert not keeps_contract(deviations.assign(position=deviations["position"].assign_attrs(units="m")))


@pytest.mark.parametrize(("name", "write"), [("laser.csv", write_deviations_csv), ("laser.rtl", write_rtl)])
def test_read_deviations_keep_the_contract(name: str, write: object, tmp_path: Path, rng: np.random.Generator) -> None:
    write(tmp_path / name, simulate(rng, cycles=2)[0])  # type: ignore[operator]
    assert keeps_contract(read_deviations(tmp_path / name))
