"""Sound campaigns are not doubted: the price of the consistency checks, quoted in docs/method/consistency.md.

Campaigns of the twin with all its undeclared effects, loads, noises and lengths, each with sound inputs; a doubt in one of them is false.
"""

from __future__ import annotations

import numpy as np
import pytest

from fusion.analysis.alignment.align import AxisGeometry, align
from fusion.analysis.alignment.readings import read_fused
from fusion.analysis.consistency.checks import Inputs
from fusion.analysis.consistency.model import compare_lines
from fusion.analysis.consistency.series import thin_fields
from fusion.analysis.drift_model.closed_loop import close_loop
from fusion.pipeline.consistency import run_checks
from fusion.results.loop import ResidualTestsPart
from fusion.twin import simulate
from fusion.twin.instruments import deviations_of, fields_of
from fusion.twin.recipe import AnomalyRecipe, EffectRecipe, Recipe
from fusion.twin.simulate import driver_log, environment_log
from tests.soak.rates import campaigns, first_seed, rate, wilson

pytestmark = pytest.mark.slow

EFFECTS = (
    "reversal_drift",
    "unseen_heat_source",
    "air_index",
    "dead_path",
    "pitch_error",
    "angular_growth",
    "laser_warm_up",
    "thermal_lag",
    "step_event",
    "periodic_disturbance",
)
ANOMALIES = ("structural", "local_temperature", "stick_slip", "step", "wander")


def sound_recipe(seed: int) -> Recipe:
    """A sound campaign drawn from the twin's options."""
    rng = np.random.default_rng([seed, 91])
    parameters = {"step_event": {"at_cycle": 15}, "periodic_disturbance": {"period_min": 23.0}}
    name = str(rng.choice(EFFECTS))
    effects = (EffectRecipe(name, float(rng.uniform(0.2, 1.5)), parameters=parameters.get(name, {})),)
    anomalies = (AnomalyRecipe(target=4, kind=str(rng.choice(ANOMALIES)), amplitude_um=0.6),)  # type: ignore[arg-type]
    return Recipe().vary(
        campaign={"seed": seed},
        test={"cycles": int(rng.integers(20, 61)), "targets": int(rng.integers(6, 17))},
        duty={"kind": str(rng.choice(["random", "constant", "switched"]))},
        laser={"noise_um": float(rng.uniform(0.1, 0.6))},
        effect=effects if rng.random() < 0.8 else (),
        anomaly=anomalies if rng.random() < 0.4 else (),
    )


#: Name of the axis, travel in mm, plan point at axis position 0 and direction on the plan.
MACHINES = {
    "as usual": ("X", 300.0, (500.0, 90.0), (-1.0, 0.0)),
    "short": ("X", 110.0, (420.0, 90.0), (-1.0, 0.0)),
    "long": ("X", 560.0, (630.0, 90.0), (-1.0, 0.0)),
    "vertical": ("Z", 140.0, (350.0, 160.0), (0.0, -1.0)),
}
#: Small, uncooled and large: columns, rows, focal length in px, noise in K, offset after a flat-field correction in K.
CAMERAS = ((320, 240, 765.0, 0.03, 0.0), (320, 240, 765.0, 0.08, 0.03), (480, 360, 1147.0, 0.03, 0.0))


def on_any_machine(seed: int) -> Recipe:
    """A sound campaign on a machine of another travel, or along the other direction of the plan, seen by one of three cameras."""
    rng, recipe = np.random.default_rng([seed, 37]), sound_recipe(seed)
    axis, travel_mm, origin_mm, direction = MACHINES[str(rng.choice(list(MACHINES)))]
    columns, rows, focal_px, netd_K, ffc_step_K = CAMERAS[int(rng.integers(len(CAMERAS)))]
    camera = {"columns": columns, "rows": rows, "focal_px": focal_px, "netd_K": netd_K, "ffc_step_K": ffc_step_K}
    test = {"spacing_mm": travel_mm / (recipe.test.targets - 1), "feed_mm_per_min": 2.0 * max(travel_mm, 150.0)}
    return recipe.vary(
        campaign={"axis": axis}, test=test, plan={"origin_mm": origin_mm, "direction": direction}, camera=camera
    )


def test_sound_campaigns_are_not_doubted(capsys: pytest.CaptureFixture[str]) -> None:
    runs, doubted, codes = campaigns(200), 0, list[str]()
    for seed in range(first_seed(41000), first_seed(41000) + runs):
        truth = simulate(on_any_machine(seed))
        deviations, environment, drivers = deviations_of(truth), environment_log(truth), driver_log(truth)
        axis = AxisGeometry(tuple(truth.recipe.plan.origin_mm), tuple(truth.recipe.plan.direction))
        fields = fields_of(truth)
        fused = align(deviations, fields, axis, environment=environment, drivers=drivers)
        result = close_loop(read_fused(fused), ["axis_expansion", "table_offset"])
        line = compare_lines(result.after, len(result.declared), fields, axis)
        loop = result.described(ResidualTestsPart.model_construct(), axis_line=line)
        extent_mm, logs = truth.recipe.plan.width_mm, {"environment": environment, "drivers": drivers}
        of_source = Inputs(
            linear=deviations, deviations=deviations, plan_extent_mm=extent_mm, reading_time=deviations["time"], **logs
        )
        of_loop = Inputs(loop=loop, travel_mm=result.after.readings.span_mm)
        checks = [
            *run_checks("source", of_source),
            *run_checks("fields", Inputs(field=thin_fields(fields), drivers=drivers)),
            *run_checks("loop", of_loop),
        ]
        failed = [check for check in checks if not check.passed]
        doubted += bool(failed)
        codes += [f"{seed} {check.code} {check.value:.3g}" for check in failed]
    with capsys.disabled():
        print(f"\nsound campaigns doubted: {rate(doubted, runs)}; {codes}")
    assert wilson(doubted, runs)[0] <= 0.02
