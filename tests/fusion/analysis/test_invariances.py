"""What must not change the models of a drift: the order in which readings and columns are stored, signs, units and epoch."""

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.alignment.readings import read_fused
from fusion.analysis.attribution.correlate import correlate
from fusion.analysis.drift_model.model import fit_model
from fusion.analysis.drift_model.record import close_record
from fusion.analysis.drift_model.record_data import reduce_record
from tests.fusion import field_simulator as simulator
from tests.fusion.record_tables import table_of
from tests.interferometry.simulated_campaigns import simulate

pytestmark = pytest.mark.long


def stored(fused: xr.Dataset) -> xr.Dataset:
    """A positioning test with its targets, approaches and cycles in another order."""
    targets, cycles = (np.random.default_rng(1).permutation(fused.sizes[name]) for name in ("target", "cycle"))
    return fused.isel(target=targets, direction=[1, 0], cycle=cycles)


def test_the_model_of_an_axis_is_that_of_its_readings():
    fused, _ = simulate(np.random.default_rng(4), cycles=15)
    fused = fused.isel(target=slice(None, None, 3))
    fused["deviation"][3, 1, 2] = fused["deviation"][7] = np.nan
    plain, found = (fit_model(read_fused(one), []) for one in (fused, stored(fused)))
    # The same readings in the same order of time; sums over the columns of the profile in another order.
    assert found.fit.sigma == pytest.approx(plain.fit.sigma, rel=1e-4)
    np.testing.assert_allclose(found.fit.residual(), plain.fit.residual(), atol=1e-3 * plain.fit.sigma)


def test_the_map_of_sources_is_that_of_the_readings():
    made = simulator.driven_session(np.random.default_rng(2), source=0)
    field = made.field[:, ::4, ::4]
    plain, found = (correlate(one, field, draws=99, checks=1) for one in (made.fused, stored(made.fused)))
    assert found.attrs["verdict"] == plain.attrs["verdict"]
    # Single precision.
    np.testing.assert_allclose(found["statistic"], plain["statistic"], rtol=1e-3, atol=1e-3)


def samples() -> xr.Dataset:
    """A record of two displacements that follow two sensors, with a step of both in the middle."""
    rng = np.random.default_rng(1)
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.1, (80, 2)), axis=0)
    displacement = (temperature - 20.0) @ np.array([[2.0, -1.0], [0.5, 3.0]]) + rng.normal(0.0, 0.1, (80, 2))
    displacement[40:] += 4.0
    return table_of(displacement, temperature, step_s=300.0)


def test_the_loop_of_a_record_finds_the_same():
    """Of the same columns in another order, with the other sign, in nanometres and fifty years earlier."""
    table, factor = samples(), 1000.0
    turned = table.assign(displacement=-factor * table["displacement"]).isel(sensor=[1, 0], channel=[1, 0])
    earlier = turned.assign_coords(time=table["time"].values - np.timedelta64(18262, "D"))
    closed, found = (close_record(reduce_record(one), ["quasi_static"]).described(()) for one in (table, earlier))
    assert [step.effect for step in found.steps] == [step.effect for step in closed.steps] == ["step_event"]
    (step,) = found.steps
    # One time for one event, within its block of 5 min: between the samples at 39 and at 40 times that.
    assert (
        step.event_s == step.parameters["time_s"] == closed.steps[0].event_s == pytest.approx(39.5 * 300.0, abs=150.0)
    )
    assert found.rmse_final_um == pytest.approx(factor * closed.rmse_final_um, rel=1e-3)
