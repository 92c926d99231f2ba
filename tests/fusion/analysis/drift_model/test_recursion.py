"""The recursion of a record's model: it predicts what the run predicted, and the fewest sensors are those that the displacement follows."""

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.drift_model.record import close_record
from fusion.analysis.drift_model.record_data import Record, reduce_record
from fusion.analysis.drift_model.recursion import fewest, make_recursion, record_of_product
from fusion.pipeline.record import record_variables
from fusion.results.loop import RecordLoop
from fusion.results.recursion import RecursionError, run_recursion
from fusion.twin.recipe import EffectRecipe
from tests.fusion.record_tables import table_of, twin_table

FROM = {"campaign": "twin", "results_sha256": "0" * 64}


def run_of(table: xr.Dataset) -> tuple[Record, xr.Dataset, RecordLoop]:
    """Record, product and loop of a run without files."""
    record = reduce_record(table)
    result = close_record(record, ["quasi_static"])
    return record, record_variables(record, result), result.described(())


@pytest.fixture(scope="module")
def driven() -> tuple[Record, xr.Dataset, RecordLoop]:
    """A spindle that no sensor sees and whose speed is logged."""
    source = EffectRecipe("unseen_heat_source", 8.0, parameters={"time_constant_min": 20.0})
    return run_of(twin_table(source, seed=3))


def test_the_recursion_from_block_to_block_follows_the_prediction_of_its_coefficients(driven):
    record, product, loop = driven
    assert "unseen_heat_source" in [step.effect for step in loop.steps]
    model = make_recursion(product, loop, sampling_s=record.block_s, **FROM)
    size = dict.fromkeys(record.sensors)
    readings = [
        record.temperature[:, record.sensors.index(one.name)]
        if one.name in size
        else record.drivers[one.name][1] * record.driver_sizes[one.name][0]
        for one in model.inputs
    ]
    wide = [one.model_copy(update={"max_step": 1e9}) for one in model.outputs]
    found = run_recursion(model.model_copy(update={"outputs": tuple(wide)}), np.column_stack(readings))
    # The run's own coefficients are those of the training part; from the whole record they hardly differ, by less than the uncertainty.
    places = [record.channels.index(one.name) for one in model.outputs]
    known = -product["predicted_final"].values[:, places]
    difference = (found.correction - known) - (found.correction - known).mean(axis=0)
    # A mean of squares over a block is not the square of the mean where the speed changes within it.
    assert (np.sqrt(np.mean(difference**2, axis=0)) < [one.u for one in model.outputs]).all()
    assert [one.before for one in model.outputs] == pytest.approx(
        [loop.channels[one.name].rmse_persistence_um for one in model.outputs]
    )
    for one in model.outputs:
        assert one.u >= loop.channels[one.name].rmse_final_um * (1.0 - 1e-9)


def test_the_product_holds_the_record_on_its_blocks(driven):
    record, product, _ = driven
    again = record_of_product(product)
    np.testing.assert_array_equal(again.rise, record.rise)
    np.testing.assert_array_equal(again.drivers["speed"][2], record.drivers["speed"][2])
    np.testing.assert_allclose(np.diff(again.seconds), np.diff(record.seconds))


def test_the_fewest_sensors_are_those_that_the_displacement_follows():
    rng = np.random.default_rng(8)
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.05, (1500, 6)), axis=0)
    displacement = (temperature[:, [1, 4]] - 20.0) @ [[6.0, 1.0], [-3.0, 5.0]] + 0.1 * rng.standard_normal((1500, 2))
    _, product, loop = run_of(table_of(displacement, temperature))
    model = make_recursion(product, loop, sampling_s=1.0, reduced=True, **FROM)
    assert [one.name for one in model.inputs] == ["t2", "t5"]
    curve = model.sensor_curve
    assert [len(one.sensors) for one in curve] == [6, 5, 4, 3, 2, 1]
    assert fewest(curve).sensors == ("t2", "t5")
    assert curve[-1].cross_rmse > 3.0 * curve[-2].cross_rmse
    assert model.remarks[0].startswith("reduced to 2 of 6 sensors: t2, t5; error on the hold-out set 0.0")
    np.testing.assert_allclose(model.outputs[0].coefficients, [6.0, -3.0], rtol=0.01)


def test_what_cannot_be_repeated_or_follows_nothing_logged_is_refused(driven):
    _, product, loop = driven
    with pytest.raises(RecursionError, match="cannot be repeated"):
        make_recursion(product.assign(predicted_final=product["predicted_final"] + 1.0), loop, sampling_s=1.0, **FROM)
    with pytest.raises(RecursionError, match="earlier version; run the campaign again"):
        make_recursion(product.drop_vars("driver_square"), loop, sampling_s=1.0, **FROM)
    own = loop.steps[0].model_copy(update={"effect": "bed_bending"})
    foreign = loop.model_copy(update={"steps": (own,), "left_out_of_forecast": ()})
    with pytest.raises(RecursionError, match="bed_bending of the model is not a first-order response"):
        make_recursion(product, foreign, sampling_s=1.0, **FROM)


def test_an_event_is_in_the_fit_and_not_in_the_recursion():
    step = EffectRecipe("step_event", 6.0, parameters={"at_cycle": 9})
    record, product, loop = run_of(twin_table(step, seed=5))
    assert "step_event" in [one.effect for one in loop.steps]
    model = make_recursion(product, loop, sampling_s=record.block_s, **FROM)
    held = "step_event" not in loop.left_out_of_forecast
    assert ("not contained, because no reading shows it: step_event" in model.remarks) is held
    assert {one.name for one in model.inputs} <= {*record.sensors, *record.drivers}
