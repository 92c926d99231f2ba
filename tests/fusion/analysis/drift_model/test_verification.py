"""The test after a compensation on a machine that follows its sensors: what is left, and what is wrong where more is."""

from dataclasses import replace

import numpy as np
import pytest

from fusion.analysis.drift_model.record import close_record
from fusion.analysis.drift_model.record_data import Record, reduce_record
from fusion.analysis.drift_model.recursion import make_recursion
from fusion.analysis.drift_model.verification import ChannelVerdict, verify
from fusion.pipeline.record import record_variables
from fusion.results.recursion import Recursion, RecursionError, run_recursion
from tests.fusion.record_tables import table_of

pytestmark = pytest.mark.long

PER_K = np.array([[6.0, 1.0], [-3.0, 5.0], [1.0, 2.0]])


def logged(seed: int, *, swing_K: float = 2.0) -> Record:
    """Two displacements that follow three temperatures, with noise."""
    rng = np.random.default_rng(seed)
    course = np.cumsum(rng.normal(0.0, 0.12, (1200, 3)), axis=0)
    temperature = 22.0 + swing_K * np.sin(course)
    displacement = (temperature - temperature[0]) @ PER_K + 0.1 * rng.standard_normal((1200, 2))
    return reduce_record(table_of(displacement, temperature))


@pytest.fixture(scope="module")
def first():
    record = logged(1)
    result = close_record(record, ["quasi_static"], effects={})
    product, loop = record_variables(record, result), result.described(())
    return product, loop, make_recursion(product, loop, campaign="", results_sha256="0", sampling_s=record.block_s)


def verified(
    first,
    *,
    gain: float = 1.0,
    runs: Recursion | None = None,
    faulty: dict[str, str] | None = None,
    swing_K: float = 1.7,
) -> list[ChannelVerdict]:
    """The second test of the machine, with what its control adds."""
    product, loop, model = first
    # Within the range of the first test, beyond which the correction is held.
    bare = logged(2, swing_K=swing_K)
    readings = bare.temperature[:, [bare.sensors.index(one.name) for one in model.inputs]]
    added = run_recursion(runs or model, readings, zero=np.arange(len(readings)) == 0).correction
    after = replace(bare, displacement=bare.displacement + gain * added)
    return verify(product, loop, after, model, faulty_sensors=faulty or {})


def test_a_compensation_that_acts_as_stated_leaves_what_was_predicted(first):
    for one in verified(first):
        assert (one.is_kept, one.fault) == (True, "")
        # Noise alone is left: some six standard deviations of a block mean of 0.07 um.
        assert one.achieved_um < one.predicted_high_um < 1.0
        assert one.before_um > 10.0
        assert one.gain == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("gain", "fault"), [(-1.0, "wrong sign"), (0.5, "half the gain"), (0.0, "not active"), (25.4, "wrong scale")]
)
def test_a_gain_that_is_wrong_is_named(first, gain, fault):
    without = [one.before_um for one in verified(first)]
    for one, before in zip(verified(first, gain=gain), without, strict=True):
        assert (one.is_kept, one.fault) == (False, fault)
        assert one.gain == pytest.approx(gain, abs=0.05 * max(1.0, abs(gain)))
        assert one.before_um == pytest.approx(before, rel=0.1)


def test_a_compensation_that_does_not_act_is_named_where_there_was_little_to_correct(first):
    for one in verified(first, gain=0.0, swing_K=0.012):
        assert one.achieved_um < one.predicted_high_um and one.gain == pytest.approx(0.0, abs=0.2)
        assert (one.is_kept, one.fault) == (False, "not active")
    assert not any(one.fault for one in verified(first, swing_K=0.012))


def test_a_driver_in_another_unit_than_the_model_reads_is_refused(first):
    product, loop, model = first
    driven = model.model_copy(
        update={"inputs": (*model.inputs, model.inputs[0].model_copy(update={"name": "n", "unit": "rpm"}))}
    )
    after = replace(logged(2), drivers={"n": {1: np.ones(1200)}}, driver_sizes={"n": (1.0, "Hz")})
    with pytest.raises(RecursionError, match="n is logged in Hz in the test after it, and the applied model reads rpm"):
        verify(product, loop, after, driven, faulty_sensors={})


def test_outputs_that_are_exchanged_are_named(first):
    one, other = first[2].outputs
    swapped = (
        one.model_copy(update={"coefficients": other.coefficients}),
        other.model_copy(update={"coefficients": one.coefficients}),
    )
    for verdict in verified(first, runs=first[2].model_copy(update={"outputs": swapped})):
        assert verdict.fault == f"axis exchanged with {other.name if verdict.name == one.name else one.name}"


def test_other_coefficients_are_named(first):
    swapped = [one.model_copy(update={"coefficients": one.coefficients[::-1]}) for one in first[2].outputs]
    for one in verified(first, runs=first[2].model_copy(update={"outputs": tuple(swapped)})):
        assert one.fault == "stale table"
        assert "other coefficients than the stated ones" in one.reason


def test_a_sensor_that_does_not_measure_is_named(first):
    for one in verified(first, faulty={"t2": "stays at 0 degC"}):
        # What the control made of it, and so what the test would have been without it, is not known.
        assert (one.fault, one.is_kept, one.before_um) == ("dead sensor", False, None)
        assert one.reason.startswith("t2 (stays at 0 degC) does not measure")


def test_a_test_without_an_input_of_the_model_is_refused(first):
    product, loop, model = first
    after = replace(logged(2), sensors=("t1", "t2", "other"))
    with pytest.raises(RecursionError, match="does not hold t3, which the applied model reads"):
        verify(product, loop, after, model, faulty_sensors={})
