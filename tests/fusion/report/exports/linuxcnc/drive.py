#!/usr/bin/python3
"""Takes the place of LinuxCNC's screen: homes, and moves X as moves.json says; what the joint is told goes into moved.json."""

import json
import subprocess
import time
from pathlib import Path

import linuxcnc

status, command = linuxcnc.stat(), linuxcnc.command()


def pin(name: str) -> float:
    return float(subprocess.run(["halcmd", "getp", name], capture_output=True, text=True, check=True).stdout)


def put(name: str, value: object) -> None:
    subprocess.run(["halcmd", "setp", name, str(value)], check=True)


def told() -> list[float]:
    return [pin(f"joint.0.{name}") for name in ("pos-cmd", "motor-pos-cmd", "motor-offset")]


def wait(done, seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not done() and time.monotonic() < end:
        time.sleep(0.05)


time.sleep(1.0)
for state in (linuxcnc.STATE_ESTOP_RESET, linuxcnc.STATE_ON):
    command.state(state)
    command.wait_complete(5)
command.mode(linuxcnc.MODE_MANUAL)
command.wait_complete(5)
command.teleop_enable(0)
command.wait_complete(5)
for joint in range(3):
    command.home(joint)
    command.wait_complete(5)


def homed() -> bool:
    status.poll()
    return all(status.homed[:3])


wait(homed)
command.mode(linuxcnc.MODE_MDI)
command.wait_complete(5)
asked = json.loads(Path("moves.json").read_text())
moved = []
for x in asked["moves"]:
    command.mdi(f"G0 X{x}")
    command.wait_complete(20)
    # On a busy machine the command is called complete before the axis has come to rest, and its correction later still.
    before, now = None, told()
    while now != before or abs(now[0] - x) > 1e-3:
        time.sleep(0.1)
        before, now = now, told()
    moved.append([x, *now])
followed = []
if asked["readings"]:
    put("axis.x.eoffset-enable", 1)
    for row in asked["readings"]:
        begun = time.time()
        for place, value in enumerate(row):
            put(f"thermofuse.reading-{place}", value)
        time.sleep(asked["settle_s"])
        pins = (
            "thermofuse.correction-0",
            "axis.x.eoffset",
            "joint.0.pos-cmd",
            "joint.0.motor-pos-cmd",
            "thermofuse.status",
        )
        followed.append([begun, time.time(), *map(pin, pins)])
Path("moved.json").write_text(json.dumps({"moved": moved, "followed": followed}))
