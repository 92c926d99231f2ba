"""Damaged files of every kind through the readers that a user's file meets: quoted in docs/measured.csv.

The contract: read or refused with a message; no other exception, no ended process, nothing above 2 s, nothing above four times the file
plus 200 MB. ``THERMOFUSE_FUZZ_INPUTS`` sets the number of inputs, ``THERMOFUSE_FUZZ_SEED`` their seed, ``THERMOFUSE_FUZZ_KINDS`` the kinds.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.soak.fuzz.harness import Kind, fuzz, shares
from tests.soak.fuzz.kinds import kinds_of_inputs, kinds_of_products

pytestmark = pytest.mark.long

#: Findings are kept here.
KEPT = Path("build/fuzz")


def judged(kinds: list[Kind], folder: Path, *, inputs: int, seed: int) -> list[str]:
    """Fuzz kinds, print a line for each, and return the breaches of the contract."""
    breaches = []
    total = 0
    for kind, share in shares(kinds, inputs):
        tally = fuzz(kind, folder, inputs=share, seed=seed)
        total += tally.inputs
        print(
            f"{kind.name:16} {tally.inputs:8} inputs: {tally.read} read, {tally.refused} refused, slowest {tally.slowest_s:.2f} s",
            flush=True,
        )
        for finding, count in tally.findings.most_common():
            line = f"{kind.name}: {finding}, {count} times, first input {tally.examples[finding]} of seed {seed}"
            breaches.append(line)
            print(f"  {line}", flush=True)
    print(f"{total} inputs, {len(breaches)} kinds of breach")
    return breaches


def test_some_damaged_inputs_of_every_kind(tmp_path: Path) -> None:
    """The quick form: it finds what happens often."""
    assert not judged(kinds_of_inputs(tmp_path), tmp_path, inputs=150, seed=7)


@pytest.mark.slow
def test_a_million_damaged_inputs(tmp_path: Path) -> None:
    inputs = int(os.environ.get("THERMOFUSE_FUZZ_INPUTS", "1000000"))
    seed = int(os.environ.get("THERMOFUSE_FUZZ_SEED", "2026"))
    wanted = os.environ.get("THERMOFUSE_FUZZ_KINDS", "").split()
    KEPT.mkdir(parents=True, exist_ok=True)
    kinds = [*kinds_of_inputs(tmp_path), *kinds_of_products(tmp_path)]
    chosen = [kind for kind in kinds if not wanted or kind.name in wanted]
    assert not judged(chosen, KEPT, inputs=inputs, seed=seed)
