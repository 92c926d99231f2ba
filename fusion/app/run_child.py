"""The process of a run: the pipeline, with its progress as one JSON object per line for the page that watches it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import typer

from fusion.messages import Terminal, answering
from fusion.pipeline.workers import second_process


def main(campaign: str, results: str, *more: str) -> int:
    """Run a campaign as `thermofuse run` does."""
    console = Terminal(stderr=True, soft_wrap=True)
    try:
        with answering(console):
            write_progress("start", 0, 1)
            from fusion.pipeline.run import run_campaign

            write_progress("start", 1, 1)
        with second_process() as worker, answering(console):
            run_campaign(Path(campaign), Path(results), resume="--resume" in more, report=write_progress, worker=worker)
    except typer.Exit as ended:
        return ended.exit_code
    return 0


def write_progress(label: str, done: int, total: int) -> None:
    """Write the progress of a step."""
    # In one piece: two processes may tell their progress at a time.
    sys.stdout.write(json.dumps({"label": label, "done": done, "total": total}) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
