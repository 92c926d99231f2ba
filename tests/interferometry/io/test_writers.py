"""Written files are read back as they were."""

import json

import numpy as np
import pytest

from interferometry.io.readings import read_deviations, read_environment
from interferometry.io.writers import write_deviations_csv, write_environment_csv, write_rtl
from tests.interferometry.simulated_campaigns import simulate


def test_rtl_round_trip(tmp_path, rng):
    deviations, _ = simulate(rng, cycles=3)
    deviations["deviation"].values[1, 0, 5] = np.nan
    environment = {"air_temperature_degC": (20.5, 21.0), "air_pressure_hPa": (1000.0, 1001.0)}
    write_rtl(tmp_path / "t.rtl", deviations, environment=environment, user_text={"machine": "X3"})
    back = read_deviations(tmp_path / "t.rtl", feed_mm_per_min=300, dwell_s=2)
    # The file prints four decimals of a micrometre.
    np.testing.assert_allclose(back["deviation"], deviations["deviation"], atol=5.1e-5)
    assert back["air_pressure"].values == pytest.approx([1000.0, 1001.0])
    assert json.loads(back.attrs["user_text"])["machine"] == "X3"


def test_rtl_writer_refuses_what_has_no_place(tmp_path, rng):
    deviations, _ = simulate(rng, cycles=2)
    with pytest.raises(ValueError, match=r"environment: wind has no place in a .rtl"):
        write_rtl(tmp_path / "t.rtl", deviations, environment={"wind": (1.0, 2.0)})


def test_csv_round_trip(tmp_path, rng):
    deviations, _ = simulate(rng, cycles=3)
    # Beyond a metre, at places with all their digits.
    deviations = deviations.assign_coords(position=1000.0 + np.pi * deviations["position"])
    write_deviations_csv(tmp_path / "t.csv", deviations)
    back = read_deviations(tmp_path / "t.csv")
    np.testing.assert_allclose(back["deviation"], deviations["deviation"], atol=5.1e-5)
    assert (back["time"].values == deviations["time"].values).all()
    assert (back["position"].values == deviations["position"].values).all()


def test_environment_csv_round_trip(tmp_path):
    source = tmp_path / "a.csv"
    source.write_text(
        "time,air_temperature_degC,air_pressure_hPa,relative_humidity_percent,material_temperature_degC\n"
        "2026-03-09T06:30:00Z,23.5,1000.2,42,23.9\n2026-03-09T06:31:00Z,23.6,1000.1,41,24.0\n",
        encoding="utf-8",
    )
    environment = read_environment(source)
    write_environment_csv(tmp_path / "b.csv", environment)
    assert read_environment(tmp_path / "b.csv").equals(environment)
