"""2,000 random campaigns of the twin: each ends in results whose invariants hold, or in a message.

``THERMOFUSE_CAMPAIGNS`` sets how many, ``THERMOFUSE_FIRST_CAMPAIGN`` the first number. What a campaign ended in is added to
``build/campaigns/outcomes.jsonl``, and a number that stands there is not run again: the test goes on where it was stopped.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from fusion.common import FusionError
from fusion.pipeline.run import run_campaign
from fusion.report.findings import summary_table
from interferometry.common import InterferometryError
from tests.soak.random_campaigns import broken_invariants, strict, write_random_campaign
from thermography.common import ThermographyError

KEPT = Path("build/campaigns")
#: Time of the processor after which a campaign counts as hung, s.
MOST_SECONDS = 600


def ran(number: int, folder: Path) -> dict[str, Any]:
    """Write and run a campaign; say what it ended in."""
    begun = time.process_time()
    campaign = write_random_campaign(number, folder / "campaign")
    said: dict[str, Any] = {"number": number}
    try:
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always", RuntimeWarning)
            summary_table(run_campaign(campaign, folder / "results"))
        said["warned"] = sorted(
            {
                f"{one.message} in {Path(one.filename).name}:{one.lineno}"
                for one in heard
                if one.category is RuntimeWarning
            }
        )
        results = strict(folder / "results" / "results.json")
        faults = broken_invariants(results)
        faults += [f"a warning that a user would see: {text}" for text in said["warned"]]
        said |= {"ended": "broken" if faults else "results", "text": "; ".join(faults[:5])}
        said["verdict"] = (results.get("loop") or {}).get("verdict", "none")
    except (FusionError, ThermographyError, InterferometryError) as error:
        said |= {"ended": "message", "text": str(error).replace(str(folder), "")}
    except Exception as error:
        stack = traceback.extract_tb(error.__traceback__)
        said |= {
            "ended": "fault",
            "text": f"{type(error).__name__}: {error} in {Path(stack[-1].filename).name}:{stack[-1].lineno}",
        }
        said["stack"] = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in stack[-8:]]
    return {**said, "seconds": round(time.process_time() - begun, 1)}


def in_a_process(number: int) -> dict[str, Any]:
    """Run a campaign in a process of its own; one that ends or hangs is an outcome too."""
    folder = Path(tempfile.mkdtemp(prefix=f"campaign-{number}-"))
    try:
        child = os.fork()
        if child == 0:
            signal.setitimer(signal.ITIMER_PROF, MOST_SECONDS)
            (folder / "outcome.json").write_text(json.dumps(ran(number, folder)))
            os._exit(0)
        _, status = os.waitpid(child, 0)
        if status:
            how = "hang" if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGPROF else "ended"
            return {"number": number, "ended": how, "text": f"status {status}", "seconds": 0.0}
        outcome: dict[str, Any] = json.loads((folder / "outcome.json").read_text())
        return outcome
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_every_campaign_ends_in_results_or_a_message() -> None:
    first = int(os.environ.get("THERMOFUSE_FIRST_CAMPAIGN", "0"))
    numbers = range(first, first + int(os.environ.get("THERMOFUSE_CAMPAIGNS", "2000")))
    KEPT.mkdir(parents=True, exist_ok=True)
    log = KEPT / "outcomes.jsonl"
    done = {
        one["number"]: one
        for line in (log.read_text().splitlines() if log.exists() else ())
        if (one := json.loads(line))
    }
    for number in numbers:
        if number not in done:
            done[number] = in_a_process(number)
            with log.open("a") as file:
                file.write(json.dumps(done[number]) + "\n")
    outcomes = [done[number] for number in numbers]
    print(Counter(one["ended"] for one in outcomes), Counter(one.get("verdict", "") for one in outcomes))
    print(f"slowest {max(one['seconds'] for one in outcomes)} s of processor")
    bad = [one for one in outcomes if one["ended"] not in ("results", "message")]
    assert not bad, f"{len(bad)} of {len(outcomes)}, the first: {bad[:5]}"
