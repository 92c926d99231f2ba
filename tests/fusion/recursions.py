"""Models of recursions for tests, and readings that take them through everything: range, failure, datum, reset."""

import numpy as np

from fusion.results.recursion import Recursion, RecursionInput, RecursionOutput, RecursionState, first_order_weights

STEPS = 4000


def some_model(*, sampling_s: float = 5.0, campaign: str = "Spindle", seed: int = 4) -> Recursion:
    """Two sensors and a driver, six states, two corrections; coefficients of a seed."""
    rng = np.random.default_rng(seed)
    ranges = {
        "t1": ("degC", 20.5, 18.0, 30.0, 2.5),
        "t 2": ("degC", 21.0, 20.0, 24.0, 2.0),
        "speed": ("1/min", 0.0, 0.0, 6000.0, 1500.0),
    }
    inputs = [
        RecursionInput(
            name=name, unit=unit, reference=zero, low=low, high=high, failed_below=low - more, failed_above=high + more
        )
        for name, (unit, zero, low, high, more) in ranges.items()
    ]
    kinds = [(0, 1, 0.0), (1, 1, 0.0), (0, 1, 1800.0), (2, 1, 0.0), (2, 2, 300.0), (2, 1, 1e6)]
    states = []
    for place, exponent, tau in kinds:
        decay, now, before = first_order_weights(tau, sampling_s)
        size = 6000.0 if place == 2 else 1.0
        states.append(
            RecursionState(
                input=place,
                size=size,
                exponent=exponent,
                time_constant_s=tau,
                decay=decay,
                now=now,
                before=before,
                start=0.0 if place == 2 and tau else 1.0,
            )
        )
    outputs = [
        RecursionOutput(
            name=name,
            unit="um",
            coefficients=tuple(rng.normal(0.0, 4.0, len(states)).tolist()),
            limit=25.0,
            max_step=25.0 * sampling_s / 60.0,
            before=20.0,
            u=1.5,
        )
        for name in ("X", "Z")
    ]
    return Recursion(
        campaign=campaign,
        results_sha256="0" * 64,
        held_out="8 h to 10 h held out",
        sampling_s=sampling_s,
        inputs=tuple(inputs),
        states=tuple(states),
        outputs=tuple(outputs),
    )


def some_readings(seed: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Readings (steps, 3) that leave their range now and then; none at first; later one off, one missing; datums, resets."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(0.0, 0.06, (STEPS, 2)), axis=0)
    speed = 6000.0 * rng.uniform(0.0, 1.02, STEPS // 200).repeat(200)
    readings = np.column_stack([24.0 + 4.0 * np.sin(walk[:, 0]), 22.0 + 2.5 * np.sin(walk[:, 1]), speed])
    readings[:3, 1] = 0.0
    readings[1500:1510, 0] = 0.0
    readings[3000, 1] = np.nan
    zero, reset = np.zeros((2, STEPS), bool)
    zero[[3, 900, 2500]] = True
    reset[[1505, 2000, 3500]] = True
    return readings, zero, reset
