"""What LinuxCNC does with a table and with a model: its real motion controller on a simulated machine, without a screen."""

import json
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pytest

from fusion.analysis.drift_model.verification import NextTest
from fusion.pipeline.plan import write_nc_program
from fusion.report.exports.controls import ErrorTable, emit, linuxcnc
from fusion.results.recursion import Kept, first_order_weights, run_recursion
from tests.fusion.recursions import some_model

HERE = Path(__file__).parent / "linuxcnc"
#: Resolution with which a correction reaches the axis: counts of 0.1 um.
COUNT_UM = 0.1

pytestmark = pytest.mark.skipif(
    shutil.which("linuxcnc") is None, reason="needs Debian's linuxcnc-uspace, which .ci/run installs"
)


def test_the_interpreter_reads_the_speeds_and_seconds_of_a_planned_test(tmp_path):
    """Of LinuxCNC, by itself: what it would do with the program."""
    minutes, speeds = [0.0, 3.0, 21.0, 27.0], [0.0, 12000.0, 6000.0, 3923.5]
    test = NextTest(0.5, 6.0, 8.0, {}, {}, {}, minutes, {"spindle": speeds}, {"spindle": "1/min"})
    write_nc_program(tmp_path / "duty.ngc", test, control="linuxcnc")
    run = ["rs274", "-g", str(tmp_path / "duty.ngc")]
    calls = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=20).stdout
    assert [float(one) for one in re.findall(r"DWELL\((.*?)\)", calls)] == [180.0, 1080.0, 360.0, 180.0]
    assert [float(one) for one in re.findall(r"SET_SPINDLE_SPEED\(0, (.*?)\)", calls)] == [12000.0, 6000.0, 3924.0]
    assert "PROGRAM_END" in calls and calls.count("START_SPINDLE_CLOCKWISE") == 3


def control(place: Path, files: dict[str, str], hal: str, asked: dict) -> dict:
    """Run LinuxCNC in a folder with some files, and return what its joint was told; not as root, under which it refuses to run."""
    for path in HERE.iterdir():
        shutil.copy(path, place)
    with (place / "sim.hal").open("a") as file:
        file.write(hal)
    for name, text in {**files, "moves.json": json.dumps(asked)}.items():
        (place / name).write_text(text, encoding="ascii")
        (place / name).chmod(0o755)
    moved = place / "moved.json"
    moved.unlink(missing_ok=True)
    command = ["timeout", "--kill-after=5", "150", "linuxcnc", "sim.ini"]
    if os.geteuid() == 0:
        for path in (place, *place.iterdir()):
            shutil.chown(path, "nobody")
        command = ["runuser", "-u", "nobody", "--", "env", f"HOME={place}", *command]
    ran = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
    assert moved.is_file(), f"{ran.stdout}\n{ran.stderr}"
    return json.loads(moved.read_text())


@pytest.fixture
def place():
    """A folder that LinuxCNC may use as another user."""
    with tempfile.TemporaryDirectory(prefix="linuxcnc", dir="/tmp") as folder:
        yield Path(folder)


@pytest.mark.long
def test_a_table_corrects_every_target_from_both_sides_by_what_it_states(place, capsys):
    position = np.array([0.0, 26.0, 48.0, 77.0, 101.0, 124.0, 153.0, 175.0])
    rng = np.random.default_rng(6)
    deviation = np.cumsum(rng.normal(0.0, 4.0, (2, 8)), axis=1)
    deviation -= deviation[0, 0]
    table = ErrorTable(position, deviation, np.full((2, 8), 0.1), 0.0, 29.0)
    up, down = position.tolist(), position[::-1].tolist()
    found = control(
        place,
        {"x.comp": linuxcnc(table, "X", ())},
        "",
        {"moves": [-5.0, *up, 190.0, *down, -5.0], "readings": [], "settle_s": 0},
    )
    moved = np.array(found["moved"])
    # The machine's command less the programmed position, without the constant that homing leaves.
    correction = 1e3 * (moved[:, 2] - moved[:, 1] - moved[:, 3])
    forward, backward = correction[1:9], correction[10:18][::-1]
    largest = 0.0
    with capsys.disabled():
        print("\nposition / mm   forward: stated, found / um   backward: stated, found / um")
        for k, at in enumerate(position):
            print(f"{at:13.1f} {-deviation[0, k]:19.3f} {forward[k]:8.3f} {-deviation[1, k]:20.3f} {backward[k]:8.3f}")
            largest = max(largest, abs(forward[k] + deviation[0, k]), abs(backward[k] + deviation[1, k]))
        print(f"largest difference {largest:.4f} um")
    assert largest <= 0.1


@pytest.mark.long
def test_a_model_beside_a_table_goes_on_after_a_restart_and_rests_when_a_sensor_fails(place, capsys):
    """A table of 8 um at X 50, a model that follows, LinuxCNC ended and started again, a sensor that fails: one log."""
    tau_s = 60.0
    decay, now, before = first_order_weights(tau_s, 0.1)
    slow = {"time_constant_s": tau_s, "decay": decay, "now": now, "before": before}
    model = some_model(sampling_s=0.1)
    states = [one.model_copy(update=slow) if one.exponent == 2 else one for one in model.states]
    # Sensors at once, and the square of the load with 40 um in a minute; nothing else, as seconds would not show it.
    first = [4.0, 3.0, 0.0, 0.0, 40.0, 0.0]
    fast = [one.model_copy(update={"max_step": 5.0, "limit": 60.0}) for one in model.outputs]
    fast[0] = fast[0].model_copy(update={"coefficients": tuple(first)})
    model = model.model_copy(update={"outputs": tuple(fast), "states": tuple(states)})
    name, text = emit(model, "model-linuxcnc")
    hal = f"loadusr -Wn thermofuse ./{name}\nsetp axis.x.eoffset-scale 0.0001\n"
    hal += "net counts thermofuse.counts-0 => axis.x.eoffset-counts\n"
    files = {name: text, "x.comp": "0 0 0\n100 100.016 100.016\n"}
    readings = [[20.5, 21.0, 0.0], [22.0, 21.5, 0.0], [24.0, 22.0, 6000.0], [26.0, 21.0, 6000.0], [26.0, 0.0, 6000.0]]

    def run(more: str, rows: list[list[float]]) -> list[list[float]]:
        return control(place, files, hal + more, {"moves": [50.0], "readings": rows, "settle_s": 2.0})["followed"]

    def stated(log: list[list[float]], rows: list[list[float]], **start) -> list[float]:
        """Corrections at the end of each reading by the model's description."""
        steps = np.repeat(rows, [round((done - begun) / model.sampling_s) for begun, done, *_ in log], axis=0)
        ends = np.cumsum([round((done - begun) / model.sampling_s) for begun, done, *_ in log]) - 1
        return run_recursion(model, steps, **start).correction[ends, 0].tolist()

    cold = run("setp thermofuse.cold 1\n", readings[:4])
    kept = json.loads((place / "thermofuse_hal.json").read_text())
    warm = run("", readings[3:])
    off_s = warm[0][0] - kept["time"]
    state = Kept(*(np.array(kept[name]) for name in ("signal", "state", "zeroed")), kept["resting"])
    known = stated(cold, readings[:4]) + stated(warm, readings[3:], cold=False, kept=state, off_s=off_s)
    log = np.array(cold + warm)[:, 2:]
    with capsys.disabled():
        print(
            f"\nstated / um   correction / um   offset / um   position / mm   motor / mm   status ({off_s:.1f} s off before row 5)"
        )
        for due, (correction, offset, at, motor, status) in zip(known, log, strict=True):
            print(f"{due:11.3f} {correction:17.3f} {1e3 * offset:13.3f} {at:15.5f} {motor:12.5f} {status:8.0f}")
    # Half a second in the order of reading and step is 0.33 um of 40 um in a minute.
    np.testing.assert_allclose(log[:, 0], known, atol=0.33)
    # The pins are read one after the other while the axis goes on: a second of it is 0.67 um.
    np.testing.assert_allclose(1e3 * log[:, 1], log[:, 0], atol=0.67 + COUNT_UM)
    np.testing.assert_allclose(1e3 * np.ptp(log[:, 3] - log[:, 2]), 0.0, atol=0.67 + COUNT_UM)
    assert log[:, 4].tolist() == [0.0] * 5 + [2.0]
    assert known[4] < known[2] < -3.0 and known[-1] == 0.0
