"""Which window by ISO 230-2 is quoted, on simulated tests: the last one is like the others, the one of least drift is not."""

import numpy as np
import pytest

from interferometry.drift.estimate import estimate_drift
from interferometry.iso230 import evaluate_windows
from tests.soak.rates import campaigns
from tests.soak.simulator import Machine, measure

pytestmark = pytest.mark.slow

RUNS = campaigns(60)


@pytest.mark.parametrize("drift", ["switched", "room", "random walk", "warm-up", "none"])
def test_the_last_window_has_the_values_of_a_late_one(drift):
    """R and A over their median in the second half of the test; beside them R of the window with the least drift, chosen by its result."""
    ratios = []
    for seed in range(RUNS):
        machine = Machine(drift=drift, cycles=60, expansion_ppm_per_K=0.0, shift_um_per_K=0.0)
        test = measure(machine, np.random.default_rng(49_000 + seed)).deviations
        windows = evaluate_windows(test, drift=estimate_drift(test)["drift"])
        late = windows.isel(window=slice(0, -1)).isel(window=slice(-6, None))
        least = int(np.argmin(late["drift_variation"].values))
        ratios.append(
            [float(late[name][at] / late[name].median()) for name, at in (("R", -1), ("A", -1), ("R", least))]
        )
    of_R, of_A, of_least = np.mean(ratios, axis=0)
    print(f"{drift}: last R {of_R:.3f}, A {of_A:.3f}; least drift R {of_least:.3f}; {RUNS} tests")
    # The standard deviation of the mean of 60 is 0.01 to 0.02.
    assert of_R == pytest.approx(1.0, abs=0.05) and of_A == pytest.approx(1.0, abs=0.05)
