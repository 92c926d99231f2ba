"""Campaigns of the twin with something undeclared in them, put through the closed loop, and what came of it.

60 cycles of 16 targets from both sides in 4.2 h, noise 0.4 um, a random walk of 0.15 um/sqrt(h) (common) and 0.1 um/sqrt(h) (stretch)
that nobody declares, and a load that is switched at random, which a campaign needs so that its effects can be told apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from fusion.analysis.alignment.align import AxisGeometry, align
from fusion.analysis.alignment.readings import Readings, read_fused
from fusion.analysis.drift_model.axis import hold_out
from fusion.analysis.drift_model.closed_loop import close_loop
from fusion.analysis.drift_model.evaluation import LoopResult
from fusion.analysis.drift_model.model import ModelFit, Term, fit_model
from fusion.analysis.drift_model.predictions import rmse
from fusion.analysis.effects.library import library
from fusion.twin import simulate
from fusion.twin.instruments import deviations_of, fields_of
from fusion.twin.recipe import EffectRecipe, Recipe
from fusion.twin.simulate import driver_log, environment_log

DECLARED = ("axis_expansion", "table_offset")
CYCLES = 60
#: Words of the right description of what stands outside the library.
SHAPES = {
    "telegraph_switching": ("negative direction only",),
    "travelling_chirp": ("positive direction only",),
    "local_creep": ("both directions",),
    "direction_scale": ("opposite in both directions",),
}


@dataclass(frozen=True)
class Outcome:
    """What the loop made of one campaign.

    Attributes
    ----------
    right : how many of the missing effects are named, alone or in a stated tie
    tied : how many of those stand in a stated tie only
    wrong : how many names were given that are no missing effect and are not tied with one
    after_over_floor : error on the hold-out cycles after the loop over that of the declared model where nothing is missing
    visible_um : rms of what is missing once static profile and declared effects have been fitted to it
    """

    seed: int
    found: LoopResult
    right: int
    tied: int
    wrong: int
    after_over_floor: float
    before_over_floor: float
    visible_um: float

    @property
    def nothing(self) -> bool:
        """Whether no name was given."""
        return not self.found.steps

    def __str__(self) -> str:
        found = self.found
        steps = ", ".join(f"{s.effect}{s.tied or ''} p {s.p_value:.1g}" for s in found.steps)
        return (
            f"{self.seed} visible {self.visible_um:.2f} error {self.before_over_floor:.2f} -> {self.after_over_floor:.2f} x floor: "
            f"{found.verdict}; {steps or '-'}; {found.remainder.shape}; blocked {sorted(found.state.blocked())}"
        )


def readings_of(*effects: EffectRecipe, seed: int, jitter_mm: float = 0.0, cycles: int = CYCLES) -> Readings:
    """Simulate a campaign without rendering frames."""
    recipe = Recipe().vary(
        campaign={"seed": seed}, test={"cycles": cycles, "jitter_mm": jitter_mm}, effect=tuple(effects)
    )
    truth = simulate(recipe)
    axis = AxisGeometry((500.0, 90.0), (-1.0, 0.0))
    fused = align(
        deviations_of(truth), fields_of(truth), axis, environment=environment_log(truth), drivers=driver_log(truth)
    )
    return read_fused(fused)


def effect_of(name: str, rms_um: float, seed: int) -> EffectRecipe:
    """One effect of a given rms; instants, periods and shapes differ from seed to seed. ``name`` may end in a shape: ``x:linear``."""
    rng = np.random.default_rng([seed, 17])
    name, _, shape = name.partition(":")
    drawn: dict[str, object] = {
        "step_event": {"at_cycle": int(rng.integers(6, CYCLES - 5)), "at_part": float(rng.uniform(0.0, 0.9))},
        "camera_offset": {"at_cycle": int(rng.integers(8, CYCLES - 8))},
        "sensor_fault": {"at_cycle": int(rng.integers(8, CYCLES - 16))},
        "periodic_disturbance": {
            "period_min": float(rng.uniform(9.0, 45.0)),
            "shape": ("flat", "linear")[int(rng.integers(2))],
        },
    }.get(name, {})  # type: ignore[assignment]
    if shape:
        drawn = {**drawn, "shape": shape}
    if name == "reflected_source":
        return EffectRecipe(name, amplitude_K=25.0, parameters=drawn)
    return EffectRecipe(name, amplitude_um=rms_um, parameters=drawn)


@cache
def without(seed: int, jitter_mm: float) -> tuple[Readings, float, ModelFit]:
    """The same campaign with nothing missing, the declared model's error on its hold-out cycles, and its fit."""
    readings = readings_of(seed=seed, jitter_mm=jitter_mm)
    used, _ = hold_out(readings)
    terms = [Term(name, next(iter(library()[name].candidates(readings, {}, None)))) for name in DECLARED]
    fit = fit_model(readings, terms, used=used)
    return readings, rmse(fit.open_loop_errors()[0]), fit


def visible_rms(readings: Readings, clean: Readings, fit: ModelFit) -> float:
    """Rms of what is missing after static profile and declared columns have been fitted to it (ordinary least squares), um."""
    difference = readings.response - clean.response
    if not np.any(difference):
        # The readings are right and the field is wrong: what is missing is what the declared model says falsely.
        true = fit.coefficients()
        for name in DECLARED:
            columns = [next(iter(library()[name].candidates(one, {}, None))).columns[:, 0] for one in (clean, readings)]
            difference = difference + true[name] * (columns[0] - columns[1])
    design = np.column_stack(
        [readings.profile, *(next(iter(library()[n].candidates(readings, {}, None))).columns for n in DECLARED)]
    )
    left = difference - design @ np.linalg.lstsq(design, difference, rcond=None)[0]
    return float(np.sqrt(np.mean(left**2)))


def examine(names: tuple[str, ...], rms_um: float, seed: int) -> Outcome:
    """Close the loop on one campaign in which the named effects are missing."""
    jitter_mm = 3.0 if "pitch_error" in names else 0.0
    readings = readings_of(*(effect_of(name, rms_um, seed) for name in names), seed=seed, jitter_mm=jitter_mm)
    clean, floor, fit = without(seed, jitter_mm)
    found = close_loop(readings, DECLARED)
    truth = {name.partition(":")[0] for name in names}
    named = [step for step in found.steps if not step.withheld]
    alone = {step.effect for step in named if not step.tied}
    said = alone | {name for step in named for name in (step.effect, *step.tied)}
    wrong = [step for step in named if step.effect not in truth and not truth & set(step.tied)]
    return Outcome(
        seed=seed,
        found=found,
        right=len(truth & said),
        tied=len(truth & said) - len(truth & alone),
        wrong=len(wrong),
        after_over_floor=found.rmse_final_um / floor,
        before_over_floor=found.rmse_declared_um / floor,
        visible_um=visible_rms(readings, clean, fit) if names else 0.0,
    )
