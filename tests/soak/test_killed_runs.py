"""Runs that are killed at random moments and resumed, also again and again, leave the undisturbed results and nothing else.

``THERMOFUSE_KILLS`` sets how many kills (50 by default), ``THERMOFUSE_KILL_SEED`` their moments.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.soak.lies.campaigns import RECIPES, write

#: Files that say when and by whom they were written.
_OF_THE_RUN = {"provenance.json", "manifest.json", "report.html"}


def start(campaign: Path, out: Path) -> subprocess.Popen[str]:
    words = [sys.executable, "-m", "thermofuse", "run", str(campaign), "--out", str(out), "--resume"]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def content(folder: Path) -> set[Path]:
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


def differences(folder: Path, undisturbed: Path) -> list[str]:
    """Files that only one of two results folders holds, and those that say something else."""
    found = [f"{name}: in one folder only" for name in content(folder) ^ content(undisturbed)]
    for name in content(folder) & content(undisturbed):
        if name.name in _OF_THE_RUN or ".stages" in name.parts:
            continue
        if name.suffix == ".nc":
            with xr.open_dataset(folder / name) as one, xr.open_dataset(undisturbed / name) as other:
                same = one.drop_attrs().identical(other.drop_attrs())
        else:
            same = (folder / name).read_bytes() == (undisturbed / name).read_bytes()
        found += [] if same else [f"{name}: differs"]
    return found


@pytest.mark.slow
def test_killed_runs_are_resumed_to_the_undisturbed_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = int(os.environ.get("THERMOFUSE_KILLS", "50"))
    rng = np.random.default_rng(int(os.environ.get("THERMOFUSE_KILL_SEED", "33")))
    write(RECIPES["effect"].vary(test={"cycles": 16, "targets": 6}), tmp_path / "campaign")
    campaign, undisturbed = tmp_path / "campaign" / "campaign.toml", tmp_path / "undisturbed"
    for out in (tmp_path / "compiled", undisturbed):
        begun = time.monotonic()
        whole = start(campaign, out)
        message = whole.communicate()[1]
        assert whole.returncode == 0, message
    lasts_s = time.monotonic() - begun
    kills, finished, wrong, out = 0, 0, list[str](), tmp_path / "0"
    while kills < wanted or out.exists():
        process = start(campaign, out)
        try:
            # The last folder is finished without another kill.
            message = process.communicate(timeout=float(rng.uniform(0.0, lasts_s)) if kills < wanted else None)[1]
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            kills += 1
            continue
        if process.returncode != 0:
            wrong.append(f"folder {out.name}: {message[-300:]}")
        else:
            wrong += [f"folder {out.name}: {what}" for what in differences(out, undisturbed)]
        finished += 1
        out = tmp_path / f"{finished}"
    with capsys.disabled():
        print(
            f"\n{kills} kills in {finished} folders, a run lasts {lasts_s:.1f} s: {len(wrong)} differences; {wrong[:5]}"
        )
    assert wrong == []
