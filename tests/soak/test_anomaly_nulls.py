"""Settled machines read in digits coarser than their noise: no anomaly where there is none, and those that exceed a digit.

100 campaigns each; THERMOFUSE_RUNS sets another number.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import special

from interferometry.anomalies import detect_anomalies
from interferometry.drift.estimate import estimate_drift
from tests.interferometry.simulated_campaigns import recorded, simulate
from tests.soak.rates import campaigns

pytestmark = pytest.mark.slow
RUNS = campaigns(100)


@pytest.mark.parametrize("noise_digits", [0.1, 0.2, 0.25, 0.3, 0.4])
def test_no_position_stands_out_by_the_digits_of_the_readings(noise_digits: float) -> None:
    """25 cycles of a settled machine in whole micrometres; what exceeds the digit stands out as it does in finer digits."""
    found = {
        name: dict.fromkeys((0.001, 1.0), 0) for name in ("nothing", "scatter of 2.5 digits", "step of 2.5 digits")
    }
    for (name, by_digit), seed in itertools.product(found.items(), range(RUNS)):
        rng = np.random.default_rng([seed, 25])
        test, _ = simulate(rng, kind="none", cycles=25, sigma=noise_digits)
        if name.startswith("scatter"):
            test["deviation"][:, :, 4] += rng.normal(0.0, 2.5, (25, 2))
        elif name.startswith("step"):
            test["deviation"][13:, :, 4] += 2.5
        for digit in by_digit:
            written = recorded(test, digit)
            named = [
                one
                for one in detect_anomalies(written, estimate_drift(written), level=0.015, permutations=999)
                if one.stands_out
            ]
            by_digit[digit] += any(one.target == 5 or name == "nothing" for one in named)
    for name, by_digit in found.items():
        print(
            f"noise of {noise_digits} digits, {name}: "
            + ", ".join(f"{n} of {RUNS} in {d} um" for d, n in by_digit.items())
        )
    # At most 0.015 of sound tests: the upper limit of its binomial count at 99 %.
    assert found["nothing"][1.0] <= special.bdtrik(0.99, RUNS, 0.015)
    assert found["scatter of 2.5 digits"][1.0] >= 0.9 * found["scatter of 2.5 digits"][0.001]
