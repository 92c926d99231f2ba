"""Functions that numba compiles: kept where a folder can be written, and compiled in memory where none can."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[1]
FILES = [
    path for name in ("fusion", "interferometry", "thermofuse", "thermography") for path in (ROOT / name).rglob("*.py")
]


def holding(pattern: str) -> list[Path]:
    return sorted(path for path in FILES if re.search(pattern, path.read_text(encoding="utf-8"), re.MULTILINE))


COMPILED = holding(r"^@njit\(")


def test_every_compiled_function_is_decorated_in_one_way():
    assert len(COMPILED) > 10
    assert holding(r"^\s*(from|import) numba") == [ROOT / "thermofuse/compiled.py"]


@pytest.mark.parametrize("named", [False, True])
def test_without_a_folder_that_can_be_written_functions_are_compiled_in_memory_with_one_notice(named, tmp_path):
    """A read-only installation and a home that cannot be written: of the places where numba looks the one that the user names is left."""
    modules = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in COMPILED]
    environment = {name: value for name, value in os.environ.items() if name != "THERMOFUSE_COMPILES_IN_MEMORY"}
    environment |= {"PYTHONPATH": str(ROOT), "NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}
    environment |= {"NUMBA_CACHE_DIR": str(tmp_path) if named else ""}
    code = f"import numpy as np, {', '.join(modules)}\nprint(thermography.io.fff_record._paeth(np.int64(3), np.int64(7), np.int64(4)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout == "7\n", "of 3, 7 and 4 the one nearest to 3 + 7 - 4 = 6"
    notices = done.stderr.splitlines()
    kept = [*tmp_path.rglob("*.nbi")]
    assert (len(notices), bool(kept)) == ((0, True) if named else (1, False)), done.stderr
    assert named or "NUMBA_CACHE_DIR" in notices[0]
