"""Every check, in the order in which results.json lists them."""

from __future__ import annotations

from fusion.analysis.consistency import camera, clocks, courses, logs, material, model, readings
from fusion.analysis.consistency.checks import Rule

RULES = {
    rule.code: rule
    for module in (readings, logs, courses, material, camera, clocks, model)
    for rule in vars(module).values()
    if isinstance(rule, Rule)
}
