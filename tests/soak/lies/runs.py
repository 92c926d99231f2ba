"""Runs of the pipeline on lying inputs, kept as JSON lines so that an interrupted soak goes on, and their counts."""

from __future__ import annotations

import contextlib
import json
import re
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from unittest import mock

import numpy as np

from fusion.common import FusionError
from fusion.pipeline.run import run_campaign
from fusion.results.results import Results
from interferometry.common import InterferometryError
from tests.soak.lies.campaigns import RECIPES, write
from tests.soak.lies.catalogue import GROUPS, LIES
from tests.soak.lies.outcome import Outcome, judge, refusal
from thermography.common import ThermographyError

#: Longest part of a message that a row keeps.
_MESSAGE = 400


@dataclass(frozen=True)
class Row:
    """One lie in one campaign.

    Attributes
    ----------
    campaign, group, lie : str
        Where the lie was planted, which idea it belongs to, and its name.
    outcome : Outcome
    wrong : tuple of str
        What is wrong in the results; also where they are doubted.
    said : tuple of str
        Codes of the doubts and notices.
    message : str
        The refusal, the end of the traceback, or the verdict with its causes.
    seconds : float
        Time of the run, s.
    """

    campaign: str
    group: str
    lie: str
    outcome: Outcome
    wrong: tuple[str, ...]
    said: tuple[str, ...]
    message: str
    seconds: float


def run_one(campaign: str, group: str, name: str, figures: bool) -> Row:
    """Plant one lie into one campaign and run it."""
    lie, begun = LIES[name], time.monotonic()
    with tempfile.TemporaryDirectory(prefix="lie_") as base, contextlib.ExitStack() as stack:
        folder, out = Path(base) / "campaign", Path(base) / "results"
        truth = write(lie.world(RECIPES[campaign]), folder)
        lie.plant(folder)
        if not figures:
            stack.enter_context(mock.patch("fusion.report.page.render_report", return_value=""))
        wrong: list[str] = []
        said: tuple[str, ...] = ()
        try:
            results = run_campaign(folder / "campaign.toml", out)
            outcome, wrong = judge(lie, truth, results, out)
            said, message = tuple(_said(results)), _verdict(results)
        except (FusionError, ThermographyError, InterferometryError) as error:
            message = f"{type(error).__name__}: {error}".replace(base, "")
            outcome = refusal(lie, message)
        except Exception:
            outcome, message = Outcome.TRACEBACK, traceback.format_exc()[-_MESSAGE:]
    return Row(campaign, group, name, outcome, tuple(wrong), said, message[:_MESSAGE], time.monotonic() - begun)


def _said(results: Results) -> Iterator[str]:
    yield from (notice.code for notice in results.warnings)


def _verdict(results: Results) -> str:
    loop = results.loop
    if loop is None:
        return "no model"
    causes = [step.effect for step in loop.steps]
    return f"{loop.verdict}: {', '.join(causes) or '-'}"


def run_all(
    path: Path,
    campaigns: Sequence[str],
    *,
    only: str = "",
    again: str | None = None,
    processes: int = 2,
    figures: bool = False,
    say: Callable[[str], None] = print,
) -> None:
    """Run all lies that `path` does not hold yet, and those whose name or group matches `again`."""
    done = {(row.campaign, row.lie) for row in read_rows(path)}
    wanted = [
        (campaign, group, lie.name)
        for campaign in campaigns
        for group, lies in GROUPS.items()
        for lie in lies
        if re.search(only, f"{group}: {lie.name}")
        and ((campaign, lie.name) not in done or (again is not None and re.search(again, f"{group}: {lie.name}")))
    ]
    # Every lie in one campaign before any in a second one: what a run that is stopped holds is a fair part of the whole.
    rng = np.random.default_rng(1)
    seen = Counter[str]()
    drawn = [wanted[at] for at in rng.permutation(len(wanted))]
    rounds = []
    for place in drawn:
        seen[place[2]] += 1
        rounds.append(seen[place[2]])
    wanted = [drawn[at] for at in np.argsort(rounds, kind="stable")]
    path.parent.mkdir(parents=True, exist_ok=True)
    # A fresh interpreter per process: a fork of one that has run threads may hang.
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(run_one, *place, figures) for place in wanted]
        for number, future in enumerate(as_completed(futures), 1):
            row = future.result()
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(row), ensure_ascii=False) + "\n")
            say(
                f"{number}/{len(futures)} {row.campaign}: {row.lie}: {row.outcome} {'; '.join(row.wrong) or row.message}"
            )


def read_rows(path: Path) -> list[Row]:
    """The rows of a file, of repeated ones the last; in the order of the catalogue."""
    rows: dict[tuple[str, str], Row] = {}
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            content = json.loads(line)
            if content["lie"] in LIES:
                row = Row(**{**content, "outcome": Outcome(content["outcome"])})
                rows[row.campaign, row.lie] = row
    order = {name: at for at, name in enumerate(LIES)}
    return sorted(rows.values(), key=lambda row: (order[row.lie], [*RECIPES].index(row.campaign)))


def counts_table(rows: Sequence[Row]) -> str:
    """A markdown table: how many lies led to each outcome; undisturbed campaigns, sound ones and declared limits apart."""
    campaigns = [name for name in RECIPES if any(row.campaign == name for row in rows)]
    lies = [row for row in rows if row.group not in ("none", "sound") and not LIES[row.lie].limit]
    counts = Counter((row.outcome, row.campaign) for row in lies)
    lines = [f"| outcome | {' | '.join(campaigns)} | all |", "|---|" + "---|" * (len(campaigns) + 1)]
    for outcome in Outcome:
        each = [counts[outcome, campaign] for campaign in campaigns]
        lines.append(f"| {outcome} | {' | '.join(map(str, each))} | {sum(each)} |")
    each = [sum(row.campaign == campaign for row in lies) for campaign in campaigns]
    lines.append(f"| lies | {' | '.join(map(str, each))} | {sum(each)} |")
    limits = [sum(row.campaign == campaign and bool(LIES[row.lie].limit) for row in rows) for campaign in campaigns]
    lines.append(f"| declared limits, not counted | {' | '.join(map(str, limits))} | {sum(limits)} |")
    return "\n".join(lines)
