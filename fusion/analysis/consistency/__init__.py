"""Checks by which the instruments, the logs and physics must agree, before a cause is named."""

from __future__ import annotations

from fusion.analysis.consistency import camera, clocks, courses, deviations, logs, material, model
from fusion.analysis.consistency.checks import Rule

#: Every check, in the order in which results.json lists them.
RULES = {
    rule.code: rule
    for module in (deviations, logs, courses, material, camera, clocks, model)
    for rule in vars(module).values()
    if isinstance(rule, Rule)
}
