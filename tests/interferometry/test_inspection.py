"""The summary of a test: missing readings, and factor, air and material compared with each other."""

import numpy as np
import pytest

from interferometry.compensation import air_index, environment_factor
from interferometry.inspection import describe_test
from interferometry.io.readings import read_deviations
from interferometry.io.writers import write_rtl
from tests.interferometry.simulated_campaigns import simulate

GENUINE = "friedcucumber__RenishawWork/data/22.rtl"
AIR = {
    "air_temperature_degC": (26.2, 26.3),
    "air_pressure_hPa": (1011.4, 1011.6),
    "relative_humidity_percent": (37.0, 38.0),
    "material_temperature_degC": (24.5, 24.6),
    "expansion_coefficient_ppm_per_K": (11.7, 11.7),
}


def test_inspection_holds_factor_air_and_material_against_each_other(tmp_path, rng):
    deviations, _ = simulate(rng, cycles=2)
    deviations["deviation"].values[:, 1] = np.nan
    deviations["deviation"].values[0, 0, 3] = np.nan
    *air, material, _ = map(np.array, AIR.values())
    for coefficient, starts in ((11.7, "environment factor"), (10.7, "warning: environment factor")):
        stated = {"material_temperature_degC": material, "expansion_coefficient_ppm_per_K": coefficient}
        factor = environment_factor(air_index(*air), **stated)
        path = tmp_path / "t.rtl"
        write_rtl(path, deviations, environment={**AIR, "environment_factor_um": (factor[0], factor[1])})
        lines = describe_test(read_deviations(path))
        assert lines[0] == "warning: 1 of 32 readings missing in the positive direction"
        assert lines[1] == "warning: no reading in the negative direction"
        assert any(line.startswith("runs without a reading: 2, 4") for line in lines)
        assert any("material 24.5 to 24.6 degC, expansion 11.7 ppm/K" in line for line in lines)
        assert lines[-1].startswith(starts)
    # 1 ppm/K over 4.55 K.
    assert "-4.55" in lines[-1] or "+4.55" in lines[-1]


@pytest.mark.real_data
def test_inspection_of_the_genuine_file(real_file):
    lines = describe_test(read_deviations(real_file(GENUINE)))
    assert "warning: no reading in the negative direction" in lines
    assert "runs without a reading: 2" in lines
    assert "a vacuum wavelength of 632.99063 nm, +0.013 ppm from" in lines[-1]
