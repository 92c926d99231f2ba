"""The campaigns that the lies are planted into: one that is complete, one with an undeclared effect, one with an anomalous target, one
seen by an uncooled camera, one under a load that is switched, whose reversal drifts.
"""

from __future__ import annotations

from pathlib import Path

from fusion.twin import simulate
from fusion.twin.instruments import write_campaign
from fusion.twin.recipe import AnomalyRecipe, EffectRecipe, Recipe
from fusion.twin.simulate import Truth
from tests.soak.lies.folder import set_key

#: As few cycles and targets, and as small pictures, as leave the answers without a lie right.
CYCLES, TARGETS, COLUMNS, ROWS = 40, 8, 320, 240
#: First cycle of the second half, in which many lies begin.
HALF = CYCLES // 2 + 1
TRAVEL_MM = 300.0
#: Coefficient that the twin's table expands with, ppm/K.
EXPANSION_PPM_PER_K = 11.7
ANOMALOUS_TARGET = 3

_SMALL = Recipe().vary(
    campaign={"seed": 1},
    test={"cycles": CYCLES, "targets": TARGETS, "spacing_mm": TRAVEL_MM / (TARGETS - 1)},
    duty={"mean_hold_min": 25.0},
    camera={"columns": COLUMNS, "rows": ROWS, "focal_px": 765.0},
)
RECIPES = {
    "sound": _SMALL,
    "effect": _SMALL.vary(
        effect=(
            EffectRecipe(
                "unseen_heat_source", 0.8, parameters={"time_constant_min": 14.0, "follows": "duty", "shape": "flat"}
            ),
        )
    ),
    "anomaly": _SMALL.vary(anomaly=(AnomalyRecipe(ANOMALOUS_TARGET, "structural", amplitude_um=0.8),)),
    "uncooled": _SMALL.vary(
        campaign={"seed": 2}, camera={"netd_K": 0.08, "ffc_step_K": 0.03}, laser={"noise_um": 0.35}
    ),
    "reversal": _SMALL.vary(
        campaign={"seed": 3}, duty={"kind": "switched"}, effect=(EffectRecipe("reversal_drift", 0.8),)
    ),
}


def write(recipe: Recipe, folder: Path) -> Truth:
    """Write a campaign and return its truth."""
    truth = simulate(recipe)
    write_campaign(truth, folder)
    set_key(folder, "plan", "cell_size", '"10 mm"')
    return truth
