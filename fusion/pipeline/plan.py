"""A duty schedule for a new test: how long, with what power, and when to switch what."""

from __future__ import annotations

from collections.abc import Sequence

from fusion.analysis.attribution.duty import DutyPlanError, Machine, plan_duty, switchings
from fusion.campaign.values import read_option
from fusion.report.numbers import duration


def duty_lines(
    sources: Sequence[str], *, effect: str, drift: str, noise: str, cycle: str, power: float, seed: int
) -> list[str]:
    """Propose a duty schedule: how long, with what power, and when to switch what."""
    named = [_source(text) for text in sources]
    machine = Machine(
        sources=tuple(name for name, _ in named),
        time_constants_s=tuple(seconds for _, seconds in named),
        effect_um=read_option("--effect", effect, "um"),
        drift_um_per_sqrt_h=read_option("--drift", drift, "um"),
        noise_um=read_option("--noise", noise, "um"),
        cycle_s=read_option("--cycle", cycle, "s"),
    )
    proposed = plan_duty(machine, power=power, seed=seed)
    reached = float(proposed["power"].sel(hours=float(proposed["test_hours"])).max())
    longest = f"; no test of up to {float(proposed['hours'].max()):g} h reaches {power:.0%}"
    lines = [
        f"test of {float(proposed['test_hours']):g} h, mean dwell {duration(float(proposed['mean_dwell']))}: "
        f"chance to name the weakest source {reached:.0%}{'' if proposed.attrs['enough'] else longest}",
        "minute  source  state",
    ]
    return lines + [f"{minute:6.0f}  {name}  {state}" for minute, name, state in switchings(proposed)]


def _source(text: str) -> tuple[str, float]:
    """Return name and time constant (s) of a heat source such as ``"spindle=40 min"``."""
    name, equals, time_constant = text.partition("=")
    if not equals or not name.strip():
        raise DutyPlanError(
            f'--source "{text}" is no source; write its name and time constant, for example "spindle=40 min"'
        )
    return name.strip(), read_option(f"--source {name.strip()}", time_constant, "s")
