"""The closed loop on records: of the twin, with known truth, and of a real machine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import load_campaign
from fusion.campaign.logged_tables import read_record
from fusion.effects.effect import Candidate, Effect
from fusion.effects.library import library
from fusion.loop.admissibility import refuse
from fusion.loop.closed_loop import open_hold_out
from fusion.loop.decisions import Reason
from fusion.record.blocks import RecordError, reduce_record
from fusion.record.effects import record_library, sensor_faults
from fusion.record.grounds import RecordGrounds, one_switching_share
from fusion.record.hold_out import declare, hold_out
from fusion.record.loop import close_record, without_unrepeated
from fusion.record.model import fit_record, simulate_channels
from fusion.record.problem import ChainedPart, RecordProblem, chain_forward, search_record
from fusion.twin.machine.recipe import EffectRecipe
from tests.fusion.record_tables import table_of, twin_table


def searched(*effects: EffectRecipe, seed: int):
    record = reduce_record(twin_table(*effects, seed=seed))
    train, _ = hold_out(record)
    return search_record(record, train, declare(["quasi_static"], record))


def test_a_complete_model_stays_as_it_is():
    result = close_record(reduce_record(twin_table(seed=44)), ["quasi_static"])
    assert (result.state.steps, result.verdict) == ((), "complete")
    told = result.as_json()
    assert told["rmse_final_um"] == told["rmse_declared_um"]
    assert {one["effects"] == [] for one in told["chained"]} == {True}


@pytest.mark.parametrize(
    ("name", "size_um", "parameters"),
    [
        ("unseen_heat_source", 1.5, {}),
        ("step_event", 1.0, {"at_cycle": 11}),
        ("periodic_disturbance", 0.6, {"period_min": 37.0}),
    ],
)
def test_one_missing_effect_is_named_and_predicts(name, size_um, parameters):
    problem, state = searched(EffectRecipe(name, size_um, parameters=parameters), seed=44)
    assert [step.effect for step in state.steps] == [name]
    assert problem.hold_out_error(state.model.terms) < problem.hold_out_error(state.declared)
    candidate = state.model.terms[-1].candidate
    if name == "periodic_disturbance":
        # The training part holds 31 periods, whose number is known to a small part of one.
        assert candidate.parameters["period_min"] == pytest.approx(37.0, rel=0.01)
    if name == "step_event":
        assert candidate.parameters["time_s"] / 3600.0 == pytest.approx(10.4, abs=0.6)  # within the eleventh hour


def test_a_load_that_was_switched_once_names_no_source(rng):
    hours = np.arange(1440) / 60.0
    speed = (hours > 2.0) * 3000.0
    source = 1.0 - np.exp(-np.maximum(hours - 2.0, 0.0) / 0.7)
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.02, (1440, 3)), axis=0)
    displacement = source[:, None] * [4.0, -3.0] + rng.normal(0.0, 0.1, (1440, 2))
    record = reduce_record(table_of(displacement, temperature, speed))
    used = np.ones(record.seconds.size, bool)
    candidate = next(
        m
        for m in record_library()[0]["unseen_heat_source"].candidates(record, None)
        if m.parameters["time_constant_min"] == 40.0
    )
    assert one_switching_share(record.drivers["speed"][1]) > 0.99
    assert one_switching_share(np.tile([0.0, 0.0, 1.0, 1.0], 50)) < 0.1
    model = fit_record(record, declare(["quasi_static"], record), used)
    refusal = refuse("unseen_heat_source", "driver", candidate, RecordGrounds(model))
    assert refusal is not None and refusal.reason is Reason.SINGLE_SWITCHING
    assert refusal.sentence.startswith("speed was switched only once")


def test_a_noisy_sensor_names_no_lag(rng):
    hours = np.arange(1440) / 60.0
    truth = 3.0 * np.sin(hours / 2.0) + np.sin(hours * 1.7)
    temperature = np.column_stack([20.0 + truth + rng.normal(0.0, 0.5, 1440), 20.0 + rng.normal(0.0, 0.5, 1440)])
    displacement = truth[:, None] * [1.0, -2.0] + rng.normal(0.0, 0.1, (1440, 2))
    record = reduce_record(table_of(displacement, temperature))
    model = fit_record(record, declare(["quasi_static"], record), np.ones(record.seconds.size, bool))
    candidate = next(
        m for m in record_library()[0]["thermal_lag"].candidates(record, None) if m.parameters["sensor"] == "t1"
    )
    refusal = refuse("thermal_lag", "field", candidate, RecordGrounds(model))
    assert refusal is not None and refusal.reason is Reason.TEMPERATURE_NOISE
    assert "fits better by its smoothness alone" in refusal.sentence


def test_channels_that_watch_one_part_are_simulated_alike(rng):
    """Two channels with one drift and one noise are one channel: independent draws would count its evidence twice."""
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.03, (1200, 2)), axis=0)
    one = (
        temperature[:, :1]
        - 20.0
        + np.cumsum(rng.normal(0.0, 0.05, (1200, 1)), axis=0)
        + rng.normal(0.0, 0.2, (1200, 1))
    )
    record = reduce_record(table_of(np.column_stack([one, one + rng.normal(0.0, 0.01, (1200, 1))]), temperature))
    model = fit_record(record, declare(["quasi_static"], record), np.ones(record.seconds.size, bool))
    first, second = simulate_channels(model, rng, draws=40)
    change = [np.corrcoef(np.diff(first[:, k]), np.diff(second[:, k]))[0, 1] for k in range(40)]
    assert np.median(change) > 0.9


def test_a_user_effect_that_raises_is_named_and_the_rest_goes_on():
    def broken(readings, coefficients, near):
        raise ZeroDivisionError("no such column")

    own = Effect("own_effect", "physics", "source", broken)
    record = reduce_record(
        twin_table(EffectRecipe("periodic_disturbance", 0.8, parameters={"period_min": 29.0}), seed=45)
    )
    train, _ = hold_out(record)
    _, state = search_record(record, train, declare(["quasi_static"], record), effects={**library(), "own_effect": own})
    assert state.not_tried()["own_effect"] == "its columns cannot be computed: ZeroDivisionError: no such column"
    assert [step.effect for step in state.steps] == ["periodic_disturbance"]


def test_a_user_effect_sees_the_record_as_readings():
    def candidates(readings, coefficients, near):
        door = ((readings.seconds / 3600.0) % 7.0 < 2.0).astype(float)
        yield Candidate(door[:, None], {}, ("um",))

    own = Effect("door", "an open door", "seen", candidates)
    table = twin_table(seed=46)
    hours = np.arange(table.sizes["time"]) / 60.0
    table["displacement"] = table["displacement"] + ((hours % 7.0 < 2.0) * 2.0)[:, None]
    record = reduce_record(table)
    train, _ = hold_out(record)
    _, state = search_record(record, train, declare(["quasi_static"], record), effects={**library(), "door": own})
    assert "door" in [step.effect for step in state.steps]


def test_what_a_record_cannot_declare_is_refused():
    record = reduce_record(twin_table(seed=44))
    with pytest.raises(RecordError) as refused:
        declare(["dead_path"], record)
    assert str(refused.value) == (
        "declared effect 'dead_path' cannot be computed from a record; declare \"quasi_static\" (every displacement linear in the "
        "temperatures), the search tries the rest of the library"
    )


def test_an_effect_that_fails_on_the_hold_out_set_is_withdrawn():
    problem, state = searched(EffectRecipe("periodic_disturbance", 0.6, parameters={"period_min": 37.0}), seed=44)
    record, rows = problem.record, ~problem.train
    displacement = record.displacement.copy()
    displacement[rows] -= (
        4.0 * np.cos(2 * np.pi * record.seconds[rows] / 2220.0)[:, None]
    )  # the wave turns against itself
    turned = RecordProblem(replace(record, displacement=displacement), problem.train, None, np.random.default_rng(1))
    kept = open_hold_out(turned, state)
    assert (kept.steps, len(kept.errors_um)) == ((), 1)
    assert kept.decisions[-1].reason is Reason.HOLD_OUT_ERROR
    assert kept.blocked()["periodic_disturbance"].startswith("withdrawn: it was found in the training part")


def test_an_effect_that_earlier_parts_did_not_bear_out_is_withdrawn():
    problem, state = searched(EffectRecipe("periodic_disturbance", 0.6, parameters={"period_min": 37.0}), seed=44)

    def part(effects: tuple[str, ...], declared: float, final: float) -> ChainedPart:
        return ChainedPart(0.0, 1.0, effects, np.array([9.0]), np.array([declared]), np.array([final]))

    name = "periodic_disturbance"
    helped, hurt, without = part((name,), 2.0, 1.0), part((name,), 1.0, 2.1), part((), 1.0, 1.0)
    assert without_unrepeated(problem, state, [without]) is state
    assert without_unrepeated(problem, state, [helped, without]) is state
    kept = without_unrepeated(problem, state, [helped, hurt, without])
    assert kept.steps == ()
    assert "the 2 earlier part(s) of the record" in kept.blocked()[name]


def test_a_quick_sensor_is_not_a_faulty_one(rng):
    """A sensor at a source answers every switching of a load that nobody logged; one jump of a slow sensor is a fault."""
    slow = 20.0 + np.cumsum(rng.normal(0.0, 0.004, (1200, 3)), axis=0)
    jumped = slow.copy()
    jumped[600:, 1] += 1.0
    quick = slow.copy()
    for first in range(100, 1100, 200):
        quick[first : first + 100, 1] += 1.0
    displacement = slow[:, :1] - 20.0 + rng.normal(0.0, 0.01, (1200, 1))
    assert [place for place, _, _ in sensor_faults(reduce_record(table_of(displacement, jumped)))] == [1]
    assert sensor_faults(reduce_record(table_of(displacement, quick))) == []


CAIVIAC = """\
[campaign]
title = "Spindle"

[record]
file = "{file}"
time = "時間(s)"
temperatures = ["t*"]
displacements = ["ch*"]
drivers = ["spindle*"]
"""


@pytest.mark.real_data
def test_the_spindle_heat_of_a_real_machine_is_found_and_predicts_the_next_load_cycle(
    tmp_path: Path, real_file: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """46.3 h of a spindle test (CAIVIAC, MIT), each speed cycle from the third on predicted from those before it."""
    path = real_file("CAIVIAC__FL_THERMAL/data/data.xlsx")
    (tmp_path / "campaign.toml").write_text(CAIVIAC.format(file=path.as_posix()), encoding="utf-8")
    record = reduce_record(read_record(load_campaign(tmp_path / "campaign.toml")))
    declared = declare(["quasi_static"], record)
    cycles = chain_forward(record, declared)
    assert [round(one.first_h) for one in cycles] == [16, 24, 32, 40]
    assert [one.effects for one in cycles] == [("unseen_heat_source",)] * 4
    before, after = (
        float(np.mean([getattr(one, name) for one in cycles])) for name in ("rmse_declared_um", "rmse_final_um")
    )
    # Known for this record: quasi-static 6.87, with spindle heat states 4.13, hindsight bound 3.19 um.
    assert after < 3.5 < 4.1 < before
    # First 60 % train, next 20 % test, as in the publication that comes with the record (no speed input there).
    share = np.arange(record.seconds.size) / record.seconds.size
    train, test = share < 0.6, (share >= 0.6) & (share < 0.8)
    problem, state = search_record(record, train, declared)
    assert ("thermal_lag", Reason.NOT_CONFIRMED) in {(one.effect, one.reason) for one in state.decisions}
    missed = np.abs(record.displacement - problem.predict(state.model.terms).predicted)[test].mean(axis=0)
    with capsys.disabled():
        print(
            f"\nCAIVIAC: RMSE {before:.2f} -> {after:.2f} um; mean absolute error by channel {missed.round(2)}, mean {missed.mean():.2f} um"
        )
    assert missed.mean() < 3.75  # the best published network
