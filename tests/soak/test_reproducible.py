"""The same campaign on 1, 2 and 8 threads gives the same results.json, byte for byte; and a run from its provenance too."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def command(*arguments: str | Path, threads: int = 1) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, **dict.fromkeys(THREADS, str(threads))}
    words = [sys.executable, "-m", "thermofuse", *map(str, arguments)]
    return subprocess.run(words, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_threads(tmp_path: Path) -> None:
    assert command("simulate", "demo", "--out", tmp_path / "campaign").returncode == 0
    written = {}
    for threads in (1, 2, 8):
        out = tmp_path / f"results_{threads}"
        ended = command("run", tmp_path / "campaign" / "campaign.toml", "--out", out, threads=threads)
        assert ended.returncode == 0, ended.stderr
        written[threads] = (out / "results.json").read_bytes()
    assert written[1] == written[2] == written[8]
    again = command("reproduce", tmp_path / "results_2", threads=2)
    assert again.returncode == 0, again.stdout + again.stderr
    assert "equal: " in again.stdout
