"""Time and memory of runs with many cycles or many targets: how they grow with the readings.

Reproduces figures of docs/measured.csv. Every run is a process of its own, so that its peak memory is; times
are of the processor, and only their ratios tell something on a machine with other work.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fusion.pipeline.test_any_subset import BOTH, write_laser

pytestmark = pytest.mark.slow

#: Runs a campaign and prints s of the whole run, s of the closed loop in it, and MB at its peak.
MEASURE = """
import json, sys, time
import fusion.pipeline.drift_model as stage
from fusion.pipeline.run import run_campaign

close_loop, loop_s = stage.close_loop, []

def timed(*given, **named):
    start = time.process_time()
    result = close_loop(*given, **named)
    loop_s.append(time.process_time() - start)
    return result

stage.close_loop = timed
start = time.process_time()
run_campaign(sys.argv[1], sys.argv[2])
whole_s = time.process_time() - start
with open("/proc/self/status") as status:
    peak = next(line for line in status if line.startswith("VmHWM"))
print(json.dumps([whole_s, *loop_s, int(peak.split()[1]) / 1024.0]))
"""


def measure(folder: Path, cycles: int, targets: int) -> tuple[float, float, float]:
    """Processor time of a run and of the closed loop in it, s, and its peak memory, MB."""
    name = f"{cycles}_{targets}"
    path = write_laser(folder / name, cycles, targets, BOTH)
    told = subprocess.run(
        [sys.executable, "-c", MEASURE, str(path), str(folder / f"{name}_results")],
        check=True,
        capture_output=True,
        text=True,
    )
    whole_s, loop_s, peak_mb = json.loads(told.stdout.splitlines()[-1])
    print(
        f"\n{cycles} cycles at {targets} targets, {2 * cycles * targets} readings: "
        f"run {whole_s:.1f} s, loop {loop_s:.1f} s, {peak_mb:.0f} MB"
    )
    return whole_s, loop_s, peak_mb


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
def test_time_and_memory_grow_with_the_cycles(tmp_path: Path) -> None:
    few, many = measure(tmp_path, 1000, 3), measure(tmp_path, 5000, 3)
    print(f"five times the cycles: run {many[0] / few[0]:.1f}, loop {many[1] / few[1]:.1f} times the time")


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
def test_time_grows_with_the_readings_not_with_a_power_of_the_targets(tmp_path: Path) -> None:
    usual = measure(tmp_path, 300, 16)
    for cycles, targets in ((12, 400), (30, 100), (500, 3)):
        run = measure(tmp_path, cycles, targets)
        print(f"against 300 at 16: run {run[0] / usual[0]:.2f}, loop {run[1] / usual[1]:.2f} times the time")
