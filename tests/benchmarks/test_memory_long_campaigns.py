"""Peak memory of whole runs with thousands of cycles, by the stage in which it is reached.

Reproduces figures of docs/measured.csv. Every run is a process of its own. The pictures are small, so that
they are soon simulated; the plan has the usual 5,040 cells, whose fields are what grows with the cycles.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from fusion.twin.instruments import write_campaign
from fusion.twin.recipe import Recipe
from fusion.twin.simulate import simulate
from tests.fusion.pipeline.test_any_subset import BOTH, write_laser

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="peak memory is read from /proc"),
]

#: Runs a campaign in one process, as ``thermofuse run --processes 1`` does, and prints MB at the peak of every stage, with mapped files
#: and without, and s of processor, of the whole and from each stage's first progress to the next one's.
MEASURE = """
import json, sys, threading, time
from fusion.pipeline.run import run_campaign

peaks, seconds, label, since = {}, {}, "start", time.process_time()

def memory(name):
    with open("/proc/self/status") as status:
        line = next(line for line in status if line.startswith(name))
    return int(line.split()[1]) / 1024.0

def note():
    whole, private = peaks.get(label, (0.0, 0.0))
    peaks[label] = max(whole, memory("VmHWM")), max(private, memory("RssAnon"))

def watch():
    while True:
        note()
        time.sleep(0.01)

def report(step, done, total):
    global label, since
    note()
    if step != label:
        now = time.process_time()
        seconds[label] = seconds.get(label, 0.0) + now - since
        label, since = step, now
        with open("/proc/self/clear_refs", "w") as peak:
            peak.write("5")

threading.Thread(target=watch, daemon=True).start()
run_campaign(sys.argv[1], sys.argv[2], resume=len(sys.argv) > 3, report=report)
report("end", 1, 1)
print(json.dumps({"peaks": peaks, "seconds": seconds, "processor_s": time.process_time()}))
"""


def write_both(folder: Path, cycles: int) -> Path:
    """A campaign of camera and laser: a frame of 160 x 120 pixels and six readings a cycle."""
    recipe = Recipe().vary(
        test={"cycles": cycles, "targets": 3, "spacing_mm": 100.0, "feed_mm_per_min": 3000.0, "period_s": 90.0},
        room={"trend_K_per_h": 0.0},
        plan={"fiducial_diameter_mm": 30.0},
        camera={"columns": 160, "rows": 120, "focal_px": 382.5, "file": "seq", "frame_after_s": 10.0},
    )
    return write_campaign(simulate(recipe), folder)


def run_measured(path: Path, out: Path, *, resume: bool = False) -> dict[str, Any]:
    """What `MEASURE` prints of a run in a process of its own."""
    told = subprocess.run(
        [sys.executable, "-c", MEASURE, str(path), str(out), *(["resume"] if resume else [])],
        check=True,
        capture_output=True,
        text=True,
    )
    found: dict[str, Any] = json.loads(told.stdout.splitlines()[-1])
    return found


def measure(path: Path, out: Path, *, resume: bool = False) -> tuple[float, float]:
    """MB at the peak of a run, with mapped files and without; prints the stages that come nearest to it and s of processor."""
    found = run_measured(path, out, resume=resume)
    print(f"\n{out.name}: {found['processor_s']:.0f} s of processor")
    for stage, (whole, private) in found["peaks"].items():
        print(f"  {stage:40s} {whole:6.0f} MB, without files {private:6.0f} MB")
    return max(whole for whole, _ in found["peaks"].values()), max(private for _, private in found["peaks"].values())


def test_memory_of_camera_and_laser_does_not_grow_with_the_cycles(tmp_path: Path) -> None:
    peaks = {}
    for cycles in (300, 1000, 3000):
        path = write_both(tmp_path / str(cycles), cycles)
        peaks[cycles], private = measure(path, tmp_path / f"{cycles}_results")
        print(f"{cycles} cycles: {peaks[cycles]:.0f} MB, without files {private:.0f} MB")
        if cycles == 1000:
            # A run whose last product is gone reads the others again.
            (tmp_path / f"{cycles}_results" / "report.html").unlink()
            measure(path, tmp_path / f"{cycles}_results", resume=True)
    # Three times the cycles took 1.01 times the memory; what held all fields would take twice as much.
    assert peaks[3000] < 1.15 * peaks[1000]


def test_memory_of_the_laser_alone(tmp_path: Path) -> None:
    whole, _ = measure(write_laser(tmp_path / "laser", 10_000, 3, BOTH), tmp_path / "laser_results")
    # It took 543 MB.
    assert whole < 600
