"""A duty schedule for a new test: how long, with what power, and when to switch what."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fusion.analysis.attribution.duty import DutyPlanError, Machine, plan_duty, switchings
from fusion.analysis.drift_model.next_test import propose_tests
from fusion.campaign.values import read_option
from fusion.results.loop import RecordLoop
from fusion.results.numbers import duration
from fusion.results.results import read_results
from fusion.results.store import read_product

#: Inputs that are named as known worst.
_NAMED = 4


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


def next_test_lines(folder: Path, *, seed: int) -> list[str]:
    """Propose the next test of a record's machine from what the last one left open."""
    results = read_results(folder)
    if not isinstance(results.loop, RecordLoop):
        raise DutyPlanError(
            f"{folder}: the results of a [record] are needed; for a positioning test name its heat sources by --source"
        )
    product = read_product(folder, "record")
    tests = list(propose_tests(product, results.loop, seed=seed))
    now = tests[0].width_now_um
    # The shortest that halves what is open, else the one that leaves least.
    best = next((one for one in tests if one.width_um <= now / 2.0), min(tests, key=lambda one: one.width_um))
    worst = ", ".join(f"{name} {um:.2g} um" for name, um in list(tests[0].open_um.items())[:_NAMED])
    names = [str(name) for name in product["driver_name"].values]
    units = [str(unit) for unit in product["driver_units"].values]
    return [
        f"standard uncertainty of a prediction under another duty: {now:.2g} um now; least known by itself: {worst}",
        *(
            f"after {one.hours:g} h, mean time at one level {one.hold_min:g} min: {one.width_um:.2g} um"
            for one in tests
        ),
        f"proposed: {best.hours:g} h",
        "minute  " + "  ".join(f"{name} / {unit}" for name, unit in zip(names, units, strict=True)),
        *(
            f"{minute:6.0f}  " + "  ".join(f"{level:g}" for level in row)
            for minute, row in zip(best.minutes, best.levels, strict=True)
        ),
    ]


def _source(text: str) -> tuple[str, float]:
    """Return name and time constant (s) of a heat source such as ``"spindle=40 min"``."""
    name, equals, time_constant = text.partition("=")
    if not equals or not name.strip():
        raise DutyPlanError(
            f'--source "{text}" is no source; write its name and time constant, for example "spindle=40 min"'
        )
    return name.strip(), read_option(f"--source {name.strip()}", time_constant, "s")
