"""Share of small changes to one module (signs, limits, comparisons, operators) that its tests notice: `make mutants`.

Works in the folder where it is started, a copy of the project: each changed text is written in place of the module, and a forked process
runs the tests. What the tests use is imported once, before the forks; the module itself and all that imports it are imported in the fork,
so that nothing of the unchanged text takes part, and no bytecode is written. Compiled kernels are cached by the time stamp of their own
file: a module whose kernels are called by kernels of another one is measured with NUMBA_DISABLE_JIT=1.

Not counted are changes that cannot change a value: of annotations, of keyword-only marks, of decorators of numba and dataclasses, and
those that no longer are Python.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import difflib
import importlib
import math
import multiprocessing
import os
import random
import re
import resource
import signal
import sys
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

_FORK = multiprocessing.get_context("fork")
#: Quick tests elsewhere that hold promises of a module, beside the file of its name; of those of the fit the ones that search for nothing,
#: which would take minutes as plain Python.
_FIT = "tests/interferometry/drift/test_gls.py"
_ALSO = {
    "interferometry/drift/kalman.py": (
        f"{_FIT}::test_agrees_with_dense_generalised_least_squares",
        f"{_FIT}::test_deletion_residual_is_the_error_of_predicting_a_reading_from_all_others",
        f"{_FIT}::test_held_out_readings_do_not_move_the_fit_and_are_predicted_in_open_loop",
        f"{_FIT}::test_the_average_of_the_drift_and_its_covariance_are_those_of_dense_algebra",
        f"{_FIT}::test_a_process_noise_scale_multiplies_the_variance_of_its_own_steps",
        "tests/interferometry/drift/test_kalman.py",
    ),
    # The memory of the noise is held where profiles and anomalies meet it.
    "interferometry/drift/gls.py": ("tests/interferometry/drift/test_estimate.py",),
    # Numbers of days, and values with their uncertainty.
    "fusion/campaign/values.py": (
        "tests/fusion/campaign/test_columns.py::test_days_counted_from_a_date_are_told_by_their_numbers_and_marked[datenum-719529]",
        "tests/fusion/campaign/test_keys.py",
    ),
    # Actions in full and in brief, and which come first.
    "fusion/report/findings.py": (
        "tests/fusion/report/test_wording.py",
        "tests/fusion/report/test_first_screen.py::test_an_action_is_cut_at_a_clause",
    ),
    # What every surface says, and the words of every check.
    "fusion/report/wording.py": (
        "tests/fusion/report/test_findings.py",
        "tests/fusion/analysis/consistency/test_every_check.py",
    ),
    # Layouts of tables as they are proposed, and so read.
    "fusion/campaign/logs.py": ("tests/fusion/campaign/test_columns.py",),
    # Declarations of keys are what forms and drafts are made of.
    "fusion/campaign/config.py": ("tests/fusion/campaign/test_keys.py",),
    # Every check once passed and once not.
    **dict.fromkeys(
        ("fusion/analysis/consistency/camera.py", "fusion/analysis/consistency/deviations.py"),
        ("tests/fusion/analysis/consistency/test_every_check.py",),
    ),
    # A record reduced, fitted and told.
    "fusion/analysis/drift_model/record.py": tuple(
        f"tests/fusion/analysis/drift_model/test_record_{part}.py" for part in ("fit", "result", "data")
    ),
    # The end of the search, and the scorer of candidates.
    "fusion/analysis/drift_model/search.py": ("tests/fusion/analysis/drift_model/test_evaluation.py",),
    "fusion/analysis/drift_model/admissibility.py": ("tests/fusion/analysis/drift_model/test_gains.py",),
}
#: Examples in the docstrings of a module.
_EXAMPLES = "tests/test_public_api.py::test_examples_in_docstrings_run"
#: Decorators that change no value, only speed and form.
_FORM = re.compile("njit|dataclass")


class _Values(ast.NodeTransformer):
    """Leave of a module what can change a value."""

    def visit_arguments(self, node: ast.arguments) -> ast.AST:
        node.args = [*node.posonlyargs, *node.args, *node.kwonlyargs]
        node.defaults = [*node.defaults, *(one for one in node.kw_defaults if one is not None)]
        node.posonlyargs, node.kwonlyargs, node.kw_defaults = [], [], []
        return self.generic_visit(node)

    def visit_arg(self, node: ast.arg) -> ast.arg:
        node.annotation = None
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        node.annotation = ast.Constant(None)
        return self.generic_visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns = None
        return self._without_form(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        return self._without_form(node)

    def _without_form(self, node: ast.FunctionDef | ast.ClassDef) -> ast.AST:
        node.decorator_list = [one for one in node.decorator_list if not _FORM.search(ast.unparse(one))]
        return self.generic_visit(node)


def _values_of(text: str) -> str:
    return ast.dump(_Values().visit(ast.parse(text)))


def changes(text: str) -> Iterator[tuple[str, int]]:
    """Operator and occurrence of every change of a text."""
    tree = get_ast(text)
    for name in sorted(operator_names()):
        kind = get_operator(name)
        if not kind.arguments():
            operator = kind()
            count = sum(1 for node in ast_nodes(tree) for _ in operator.mutation_positions(node))
            yield from ((name, number) for number in range(count))


def changed_texts(text: str, sample: int, seed: int) -> Iterator[str]:
    """Changed texts in random order, as many as asked for (0: all), without those that change no value."""
    places = list(changes(text))
    random.Random(seed).shuffle(places)
    values, seen = _values_of(text), set()
    for name, number in places:
        changed = mutate_code(text, get_operator(name)(), number)
        try:
            meaning = _values_of(changed)
        except SyntaxError:
            continue
        if meaning == values or meaning in seen:
            continue
        seen.add(meaning)
        yield changed
        if len(seen) == sample:
            return


def _run_tests(tests: list[str]) -> int:
    return int(
        pytest.main(["-q", "-x", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning", *tests])
    )


def _run_unchanged(tests: list[str], answer: Connection) -> None:
    """Run the tests and send their code, their processor time, and the modules that they used."""
    code = _run_tests(tests)
    used = [name for name in sys.modules if not name.startswith(("tests", "conftest", "pytest", "_pytest"))]
    answer.send((code, time.process_time(), used))


def _run_changed(tests: list[str], seconds: int) -> None:
    """Run the tests in silence and end with their code; more than the allowed processor time ends it by a signal."""
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    signal.alarm(20 * seconds)
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    os.dup2(sink, 2)
    os._exit(_run_tests(tests))


def passes(tests: list[str], seconds: int) -> bool:
    """Whether the tests pass in a fork of this process, within seconds of processor time."""
    process = _FORK.Process(target=_run_changed, args=(tests, seconds))
    process.start()
    process.join()
    return process.exitcode == 0


def _stand_ready(module: Path, tests: list[str]) -> int:
    """Import what the tests use, but for the module and all that imports it; returns their processor time in s."""
    answer, theirs = _FORK.Pipe(duplex=False)
    process = _FORK.Process(target=_run_unchanged, args=(tests, theirs))
    process.start()
    theirs.close()
    try:
        code, seconds, used = answer.recv()
    except EOFError:
        process.join()
        raise SystemExit(f"the tests end their process, with code {process.exitcode}, without any change") from None
    process.join()
    if code:
        raise SystemExit("the tests fail without any change")
    name = ".".join(module.with_suffix("").parts)
    sys.modules[name] = None  # type: ignore[assignment]  # Importing it fails, and with it all that needs it.
    for one in used:
        with contextlib.suppress(Exception):
            importlib.import_module(one)
    del sys.modules[name]
    for cached in (module.parent / "__pycache__").glob(f"{module.stem}.*.pyc"):
        cached.unlink()
    return math.ceil(seconds)


def main() -> None:
    """Change, test, restore, count; ends with 1 below the share asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("module", type=Path)
    parser.add_argument("--sample", type=int, default=0, help="number of changes taken at random; 0: all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--share", type=float, default=0.9)
    given = parser.parse_args()
    module: Path = given.module
    text = module.read_text(encoding="utf-8")
    tests = [str("tests" / module.parent / f"test_{module.name}"), *_ALSO.get(str(module), ())]
    if ">>> " in text:
        tests.append(f"{_EXAMPLES}[{'.'.join(module.with_suffix('').parts)}]")
    sys.path.insert(0, str(Path.cwd()))
    allowed = 10 + 3 * _stand_ready(module, tests)
    if not passes(tests, allowed):
        raise SystemExit("the tests fail in a fork without any change")
    found, count, started = 0, 0, time.monotonic()
    try:
        for count, changed in enumerate(changed_texts(text, given.sample, given.seed), start=1):
            module.write_text(changed, encoding="utf-8")
            if passes(tests, allowed):
                lines = difflib.unified_diff(text.splitlines(), changed.splitlines(), lineterm="", n=0)
                print(f"survives, change {count}:", *list(lines)[2:], sep="\n", flush=True)
            else:
                found += 1
    finally:
        module.write_text(text, encoding="utf-8")
    print(f"{module}: {found} of {count} found ({found / max(count, 1):.0%}), {time.monotonic() - started:.0f} s")
    raise SystemExit(found < given.share * count)


if __name__ == "__main__":
    main()
