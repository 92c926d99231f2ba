"""What LinuxCNC does with a table and with a model: its real motion controller on a simulated machine, without a screen."""

import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pytest

from fusion.report.exports.controls import ErrorTable, emit, linuxcnc
from fusion.results.recursion import run_recursion
from tests.fusion.recursions import some_model

HERE = Path(__file__).parent / "linuxcnc"
#: Resolution with which a correction reaches the axis: counts of 0.1 um.
COUNT_UM = 0.1

pytestmark = [
    pytest.mark.skipif(
        shutil.which("linuxcnc") is None, reason="needs Debian's linuxcnc-uspace, which .ci/run installs"
    ),
    pytest.mark.long,
]


def control(files: dict[str, str], hal: str, asked: dict) -> dict:
    """Run LinuxCNC with some files, and return what its joint was told; not as root, under which it refuses to run."""
    with tempfile.TemporaryDirectory(prefix="linuxcnc", dir="/tmp") as folder:
        place = Path(folder)
        for path in HERE.iterdir():
            shutil.copy(path, place)
        with (place / "sim.hal").open("a") as file:
            file.write(hal)
        for name, text in {**files, "moves.json": json.dumps(asked)}.items():
            (place / name).write_text(text, encoding="ascii")
            (place / name).chmod(0o755)
        command = ["timeout", "--kill-after=5", "150", "linuxcnc", "sim.ini"]
        if os.geteuid() == 0:
            for path in (place, *place.iterdir()):
                shutil.chown(path, "nobody")
            command = ["runuser", "-u", "nobody", "--", "env", f"HOME={place}", *command]
        ran = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
        assert (place / "moved.json").is_file(), f"{ran.stdout}\n{ran.stderr}"
        return json.loads((place / "moved.json").read_text())


def test_a_table_corrects_every_target_from_both_sides_by_what_it_states(capsys):
    position = np.array([0.0, 26.0, 48.0, 77.0, 101.0, 124.0, 153.0, 175.0])
    rng = np.random.default_rng(6)
    deviation = np.cumsum(rng.normal(0.0, 4.0, (2, 8)), axis=1)
    deviation -= deviation[0, 0]
    table = ErrorTable(position, deviation, np.full((2, 8), 0.1), 0.0, 29.0)
    up, down = position.tolist(), position[::-1].tolist()
    found = control(
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


def test_a_model_moves_the_axis_and_a_failed_sensor_brings_it_to_rest(capsys):
    model = some_model(sampling_s=0.1)
    # The states of a test of seconds: those without memory, so that the order of reading and step does not matter.
    quick = [0.0 if model.states[k].time_constant_s else value for k, value in enumerate(model.outputs[0].coefficients)]
    fast = [one.model_copy(update={"max_step": 5.0}) for one in model.outputs]
    fast[0] = fast[0].model_copy(update={"coefficients": tuple(quick)})
    model = model.model_copy(update={"outputs": tuple(fast)})
    name, text = emit(model, "model-linuxcnc")
    readings = [[20.5, 21.0, 0.0], [22.0, 21.5, 0.0], [24.0, 22.0, 1500.0], [26.0, 21.0, 3000.0], [26.0, 0.0, 3000.0]]
    hal = f"loadusr -Wn thermofuse ./{name}\nsetp thermofuse.cold 1\nsetp axis.x.eoffset-scale 0.0001\n"
    hal += "net counts thermofuse.counts-0 => axis.x.eoffset-counts\n"
    found = control(
        {name: text, "x.comp": "0 0 0\n300 300 300\n"}, hal, {"moves": [50.0], "readings": readings, "settle_s": 3.0}
    )
    followed = np.array(found["followed"])
    known = np.array([run_recursion(model, np.tile(row, (40, 1))).correction[-1, 0] for row in readings[:4]] + [0.0])
    with capsys.disabled():
        print("\nstated / um   correction / um   offset of the axis / um   position / mm   status")
        for stated, (correction, offset, at, status) in zip(known, followed, strict=True):
            print(f"{stated:11.3f} {correction:17.3f} {1e3 * offset:25.3f} {at:15.5f} {status:8.0f}")
    np.testing.assert_allclose(followed[:, 0], known, atol=1e-6)
    np.testing.assert_allclose(1e3 * followed[:, 1], known, atol=COUNT_UM)
    assert np.ptp(known) > 5.0
    assert followed[-1, 3] == 2.0
