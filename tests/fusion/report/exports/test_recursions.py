"""The emitted programs against the recursion in Python: C compiled, Structured Text interpreted, the HAL component imported."""

import json
import math
import re
import runpy
import shutil
import subprocess

import numpy as np
import pytest

from fusion.report.exports.controls import ExportError, emit
from fusion.results.recursion import FAILED, OK, SATURATED, UNKNOWN, UNTIMELY, Recursion, run_recursion
from tests.fusion.recursions import STEPS, some_model, some_readings

#: Programs and Python differ by rounding alone, um.
ROUNDING_UM = 1e-9
_HOSTILE = "Halle 7 */ int x; /* *) END_FUNCTION_BLOCK (* \n import os"

#: Steps before a control stops, how long it is off (s), and the step from which it runs at twice its period for a while.
STOPPED, OFF_S, LATE = 2600, 4320.0, slice(3600, 3700)
ELAPSED_S = np.full(STEPS, 5.0)
ELAPSED_S[LATE] = 10.0

DRIVER = """
#include "thermofuse.h"
#include <stdio.h>
int main(int count, char **words)
{
    thermofuse_t model;
    double r[3], elapsed;
    int zero, reset, step = 0;
    thermofuse_init(&model, words[count - 1][0] == 'c');
    while (scanf("%lf %lf %lf %lf %d %d", &r[0], &r[1], &r[2], &elapsed, &zero, &reset) == 6) {
        if (step++ == 2600) {
            thermofuse_resume(&model, 4320.0);
        }
        thermofuse_step(&model, r, elapsed, zero != 0, reset != 0);
        printf("%.17g %.17g %d\\n", model.correction[0], model.correction[1], model.status);
    }
    return 0;
}
"""


@pytest.fixture(params=[True, False], ids=["cold", "not known"])
def cold(request) -> bool:
    return request.param


@pytest.fixture(params=["Spindle", _HOSTILE])
def model(request) -> Recursion:
    return some_model(campaign=request.param)


def test_the_json_is_the_description_itself(model):
    name, text = emit(model, "model-json")
    assert name == "model.json"
    assert Recursion.model_validate(json.loads(text)) == model


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_the_c_header_compiles_without_a_warning_and_gives_the_same(model, cold, tmp_path):
    name, text = emit(model, "model-c")
    (tmp_path / name).write_text(text, encoding="ascii")
    (tmp_path / "main.c").write_text(DRIVER, encoding="ascii")
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror"]
    subprocess.run(["gcc", *strict, "main.c", "-o", "main"], cwd=tmp_path, check=True)
    assert not re.search(r"\b(malloc|free|goto|#include <(?!stdbool))\b", text)
    readings, zero, reset = some_readings()
    rows = np.column_stack([readings, ELAPSED_S, zero, reset]).tolist()
    lines = [f"{a!r} {b!r} {c!r} {late!r} {z:.0f} {r:.0f}" for a, b, c, late, z, r in rows]
    started = [tmp_path / "main", "cold" if cold else "unknown"]
    ran = subprocess.run(started, input="\n".join(lines), capture_output=True, text=True, check=True)
    compare(model, cold, np.array([line.split() for line in ran.stdout.splitlines()], float))


def test_the_structured_text_gives_the_same(model, cold):
    _, text = emit(model, "model-st")
    block = interpret(text)
    block |= {"cold": cold, "off_s": -1.0}
    readings, zero, reset = some_readings()
    found = []
    for step in range(STEPS):
        if step == STOPPED:
            # The retained variables outlive the restart, the others begin anew.
            kept = {name: block[name] for name in ("signal", "state", "zeroed", "resting", "made_for")}
            block = interpret(text) | kept | {"off_s": OFF_S}
        block |= {"reading": readings[step], "zero": bool(zero[step]), "reset": bool(reset[step])}
        block |= {"elapsed_s": ELAPSED_S[step]}
        block["call"](block)
        found.append([*block["correction"], block["status"]])
    compare(model, cold, np.array(found))


def test_the_hal_component_gives_the_same(model, cold, tmp_path):
    name, text = emit(model, "model-linuxcnc")
    (tmp_path / name).write_text(text, encoding="ascii")
    make = runpy.run_path(str(tmp_path / name))["Model"]
    component = make(cold)
    readings, zero, reset = some_readings()
    found = []
    for step in range(STEPS):
        if step == STOPPED:
            component = make(False, json.loads(json.dumps(component.kept())), OFF_S)
        component.step(readings[step].tolist(), bool(zero[step]), bool(reset[step]), ELAPSED_S[step])
        found.append([*component.correction, component.status])
    compare(model, cold, np.array(found))


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_memory_that_another_model_kept_is_no_state(tmp_path):
    name, text = emit(some_model(), "model-c")
    (tmp_path / name).write_text(text, encoding="ascii")
    program = DRIVER.replace("thermofuse_resume(&model, 4320.0)", "model.made_for++; thermofuse_resume(&model, 4320.0)")
    (tmp_path / "main.c").write_text(program, encoding="ascii")
    subprocess.run(["gcc", "main.c", "-o", "main"], cwd=tmp_path, check=True)
    lines = "\n".join(["25.0 22.0 3000.0 5.0 0 0"] * (STOPPED + 2))
    ran = subprocess.run([tmp_path / "main", "c"], input=lines, capture_output=True, text=True, check=True)
    status = [int(line.split()[-1]) for line in ran.stdout.splitlines()]
    assert status[STOPPED - 1] in (OK, SATURATED) and status[STOPPED:] == [UNKNOWN] * 2


def test_a_model_without_an_uncertainty_is_not_written():
    model = some_model()
    unknown = [one.model_copy(update={"u": float("nan")}) for one in model.outputs]
    with pytest.raises(ExportError, match="uncertainty of a correction is not known"):
        emit(model.model_copy(update={"outputs": tuple(unknown)}), "model-c")


def compare(model: Recursion, cold: bool, found: np.ndarray) -> None:
    """Hold corrections and status (steps, outputs + 1) to those of Python, from a start, a stop and a restart."""
    readings, zero, reset = some_readings()
    first, second = slice(0, STOPPED), slice(STOPPED, STEPS)
    before = run_recursion(
        model, readings[first], zero=zero[first], reset=reset[first], elapsed_s=ELAPSED_S[first], cold=cold
    )
    after = run_recursion(
        model, readings[second], zero=zero[second], reset=reset[second], elapsed_s=ELAPSED_S[second],
        kept=before.kept, off_s=OFF_S,
    )  # fmt: skip
    correction, status = np.vstack([before.correction, after.correction]), np.r_[before.status, after.status]
    assert set(status) == ({OK, SATURATED, FAILED, UNKNOWN, UNTIMELY} if cold else {FAILED, UNKNOWN, UNTIMELY})
    np.testing.assert_allclose(found[:, :-1], correction, rtol=0.0, atol=ROUNDING_UM)
    np.testing.assert_array_equal(found[:, -1], status)


def interpret(text: str) -> dict:
    """A function block of the emitted subset as Python: its variables with their initial values, and `call`, one call of it.

    The subset: arrays of LREAL and INT, FOR, IF, assignments, RETURN, LIMIT, EXP; no open compiler of Structured Text is in Debian or PyPI.
    """
    code = re.sub(r"\(\*.*?\*\)", "", text, flags=re.DOTALL)
    for name, array in re.findall(r"(T_\w+) : (ARRAY\[.*?\] OF LREAL);", code):
        code = code.replace(f": {name};", f": {array};")
    body = code[code.rindex("END_VAR") + len("END_VAR") : code.index("END_FUNCTION_BLOCK")]
    block: dict = {
        "LIMIT": lambda low, value, high: min(max(value, low), high),
        "EXP": math.exp,
        "LREAL_TO_DINT": round,
    }
    for name, first, last, values in re.findall(
        r"(\w+) : ARRAY\[(\d+)\.\.(\d+)\] OF \w+(?: := \[(.*?)\])?;", code, re.DOTALL
    ):
        block[name] = json.loads(f"[{values}]") if values else [0.0] * (int(last) + 1)
        assert len(block[name]) == int(last) - int(first) + 1, name
    for name, kind, value in re.findall(r"^    (\w+) : (LREAL|D?INT|BOOL)(?: := (\S+))?;", code, re.MULTILINE):
        block[name] = False if kind == "BOOL" else float(value or 0) if kind == "LREAL" else int(value or 0)
    lines, depth = [f"    global {', '.join(name for name in block if name.isidentifier())}"], 1
    for line in (one.strip() for one in body.splitlines() if one.strip()):
        if line.startswith(("END_", "ELSE", "ELSIF")):
            depth -= 1
        python = _statement(line)
        if python:
            lines.append("    " * depth + python)
        if line.startswith(("FOR", "IF", "ELSE", "ELSIF")):
            depth += 1
    assert depth == 1
    program = compile("\n".join(["def program():", *lines]), "thermofuse.st", "exec")

    def call(variables: dict) -> None:
        exec(program, variables)
        variables["program"]()

    return block | {"call": call}


def _statement(line: str) -> str:
    """One line of the subset in Python; empty for the end of a block."""
    for word, python in {"AND": "and", "OR": "or", "NOT": "not", "TRUE": "True", "FALSE": "False"}.items():
        line = re.sub(rf"\b{word}\b", python, line)
    if line.startswith("END_"):
        return ""
    if loop := re.fullmatch(r"FOR (\w+) := (\d+) TO (\d+) DO", line):
        return f"for {loop[1]} in range({loop[2]}, {loop[3]} + 1):"
    if line == "ELSE":
        return "else:"
    if line == "RETURN;":
        return "return"
    if branch := re.fullmatch(r"(IF|ELSIF) (.*) THEN", line):
        return f"{'if' if branch[1] == 'IF' else 'elif'} {re.sub(r'(?<![<>:])=', '==', branch[2])}:"
    assignment = re.fullmatch(r"([\w\[\]]+) := (.*);", line)
    assert assignment, line
    return f"{assignment[1]} = {re.sub(r'(?<![<>:])=', '==', assignment[2])}"
