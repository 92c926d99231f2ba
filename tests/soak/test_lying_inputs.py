"""Inputs that lie lead to no confident wrong answer: every lie in every campaign of `tests.soak.lies.campaigns`, one at a time.

``THERMOFUSE_LIES=<file>`` names a file of rows that is kept and continued, as ``python -m tests.soak.lies --out <file>`` writes it.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from tests.soak.lies.campaigns import RECIPES
from tests.soak.lies.catalogue import GROUPS, LIES
from tests.soak.lies.outcome import Outcome
from tests.soak.lies.runs import counts_table, read_rows, run_all


def test_every_lie_has_a_name_of_its_own_and_words_that_name_it() -> None:
    assert len(LIES) == sum(len(lies) for lies in GROUPS.values())
    assert all(re.compile(lie.family) for lie in LIES.values())


@pytest.mark.slow
def test_no_confident_wrong_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = Path(os.environ.get("THERMOFUSE_LIES", tmp_path / "lies.jsonl"))
    run_all(path, [*RECIPES])
    rows = read_rows(path)
    with capsys.disabled():
        print(f"\n{counts_table(rows)}")
    places = {outcome: [f"{row.campaign}: {row.lie}" for row in rows if row.outcome is outcome] for outcome in Outcome}
    assert places[Outcome.TRACEBACK] == []
    undisturbed = [row for row in rows if row.group == "none"]
    assert len(undisturbed) == len(RECIPES) and all(row.outcome is Outcome.RIGHT for row in undisturbed)
    sound = [row for row in rows if row.group == "sound"]
    assert [f"{row.campaign}: {row.lie}: {row.said}" for row in sound if row.outcome.startswith("doubted")] == []
    silent = [row for row in rows if row.outcome is Outcome.SILENTLY_WRONG and not LIES[row.lie].limit]
    assert [f"{row.campaign}: {row.lie}: {'; '.join(row.wrong)}" for row in silent] == []
