"""The emitted programs against the recursion in Python: C compiled, Structured Text interpreted, the HAL component imported."""

import json
import re
import runpy
import shutil
import subprocess

import numpy as np
import pytest

from fusion.report.exports.controls import ExportError, emit
from fusion.results.recursion import Recursion, run_recursion
from tests.fusion.recursions import STEPS, some_model, some_readings

#: Programs and Python differ by rounding alone, um.
ROUNDING_UM = 1e-9
_HOSTILE = "Halle 7 */ int x; /* *) END_FUNCTION_BLOCK (* \n import os"

DRIVER = """
#include "thermofuse.h"
#include <stdio.h>
int main(void)
{
    thermofuse_t model;
    double r[3];
    int zero, reset;
    thermofuse_init(&model);
    while (scanf("%lf %lf %lf %d %d", &r[0], &r[1], &r[2], &zero, &reset) == 5) {
        thermofuse_step(&model, r, zero != 0, reset != 0);
        printf("%.17g %.17g %d\\n", model.correction[0], model.correction[1], model.status);
    }
    return 0;
}
"""


@pytest.fixture(params=["Spindle", _HOSTILE])
def model(request) -> Recursion:
    return some_model(campaign=request.param)


def test_the_json_is_the_description_itself(model):
    name, text = emit(model, "model-json")
    assert name == "model.json"
    assert Recursion.model_validate(json.loads(text)) == model


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_the_c_header_compiles_without_a_warning_and_gives_the_same(model, tmp_path):
    name, text = emit(model, "model-c")
    (tmp_path / name).write_text(text, encoding="ascii")
    (tmp_path / "main.c").write_text(DRIVER, encoding="ascii")
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror"]
    subprocess.run(["gcc", *strict, "main.c", "-o", "main"], cwd=tmp_path, check=True)
    assert not re.search(r"\b(malloc|free|goto|#include <(?!stdbool))\b", text)
    readings, zero, reset = some_readings()
    lines = [
        f"{a!r} {b!r} {c!r} {int(z)} {int(r)}" for (a, b, c), z, r in zip(readings.tolist(), zero, reset, strict=True)
    ]
    ran = subprocess.run([tmp_path / "main"], input="\n".join(lines), capture_output=True, text=True, check=True)
    compare(model, np.array([line.split() for line in ran.stdout.splitlines()], float))


def test_the_structured_text_gives_the_same(model):
    _, text = emit(model, "model-st")
    block = interpret(text)
    readings, zero, reset = some_readings()
    found = []
    for step in range(STEPS):
        block |= {"reading": readings[step], "zero": bool(zero[step]), "reset": bool(reset[step])}
        exec(block["program"], block)
        found.append([*block["correction"], block["status"]])
    compare(model, np.array(found))


def test_the_hal_component_gives_the_same(model, tmp_path):
    name, text = emit(model, "model-linuxcnc")
    (tmp_path / name).write_text(text, encoding="ascii")
    component = runpy.run_path(str(tmp_path / name))["Model"]()
    readings, zero, reset = some_readings()
    found = []
    for step in range(STEPS):
        component.step(readings[step].tolist(), bool(zero[step]), bool(reset[step]))
        found.append([*component.correction, component.status])
    compare(model, np.array(found))


def test_a_model_without_an_uncertainty_is_not_written():
    model = some_model()
    unknown = [one.model_copy(update={"u": float("nan")}) for one in model.outputs]
    with pytest.raises(ExportError, match="uncertainty of a correction is not known"):
        emit(model.model_copy(update={"outputs": tuple(unknown)}), "model-c")


def compare(model: Recursion, found: np.ndarray) -> None:
    """Hold corrections and status (steps, outputs + 1) to those of Python."""
    readings, zero, reset = some_readings()
    known = run_recursion(model, readings, zero=zero, reset=reset)
    np.testing.assert_allclose(found[:, :-1], known.correction, rtol=0.0, atol=ROUNDING_UM)
    np.testing.assert_array_equal(found[:, -1], known.status)


def interpret(text: str) -> dict:
    """A function block of the emitted subset as Python: its variables with their initial values, and `program`, one call of it.

    The subset: arrays of LREAL and INT, FOR, IF, assignments, LIMIT; no open compiler of Structured Text is in Debian or PyPI.
    """
    code = re.sub(r"\(\*.*?\*\)", "", text, flags=re.DOTALL)
    body = code[code.rindex("END_VAR") + len("END_VAR") : code.index("END_FUNCTION_BLOCK")]
    block: dict = {"LIMIT": lambda low, value, high: min(max(value, low), high)}
    for name, first, last, values in re.findall(
        r"(\w+) : ARRAY\[(\d+)\.\.(\d+)\] OF \w+(?: := \[(.*?)\])?;", code, re.DOTALL
    ):
        block[name] = json.loads(f"[{values}]") if values else [0.0] * (int(last) + 1)
        assert len(block[name]) == int(last) - int(first) + 1, name
    for name, kind in re.findall(r"^    (\w+) : (LREAL|INT|BOOL);", code, re.MULTILINE):
        block[name] = False if kind == "BOOL" else 0
    lines, depth = [], 0
    for line in (one.strip() for one in body.splitlines() if one.strip()):
        if line.startswith(("END_", "ELSE", "ELSIF")):
            depth -= 1
        python = _statement(line)
        if python:
            lines.append("    " * depth + python)
        if line.startswith(("FOR", "IF", "ELSE", "ELSIF")):
            depth += 1
    assert depth == 0
    return block | {"program": compile("\n".join(lines), "thermofuse.st", "exec")}


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
    if branch := re.fullmatch(r"(IF|ELSIF) (.*) THEN", line):
        return f"{'if' if branch[1] == 'IF' else 'elif'} {re.sub(r'(?<![<>:])=', '==', branch[2])}:"
    assignment = re.fullmatch(r"([\w\[\]]+) := (.*);", line)
    assert assignment, line
    return f"{assignment[1]} = {assignment[2]}"
