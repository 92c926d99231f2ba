"""Run lies through the command's pipeline and print what it answers.

``python -m tests.soak.lies --out lies.jsonl`` goes on where an interrupted run stopped; ``--again PATTERN`` repeats rows; the counts are
printed at the end. ``--campaign``, ``--only PATTERN`` and ``--processes`` choose what is run.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tests.soak.lies.campaigns import RECIPES
from tests.soak.lies.runs import counts_table, read_rows, run_all


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.soak.lies", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="JSON lines, one per run; kept and continued")
    parser.add_argument("--campaign", action="append", choices=[*RECIPES], help="one or several; all by default")
    parser.add_argument("--only", default="", help="regular expression on the lies' names and groups")
    parser.add_argument("--again", default=None, help="regular expression: repeat these rows")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--figures", action="store_true", help="draw the figures of the reports as well, which doubles the time"
    )
    options = parser.parse_args()
    campaigns = options.campaign or [*RECIPES]
    run_all(
        options.out,
        campaigns,
        only=options.only,
        again=options.again,
        processes=options.processes,
        figures=options.figures,
        say=lambda text: print(text, flush=True),
    )
    rows = [row for row in read_rows(options.out) if row.campaign in campaigns]
    print(f"\n{counts_table(rows)}")


if __name__ == "__main__":
    main()
