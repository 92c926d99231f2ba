"""Table of what was fast before and is now, measured in one run: `make speeds BEFORE=<commit>`.

Both trees measure themselves with their own benchmarks, in turns, against the same named peers on the same machine; commands of the
program are timed by the clock, each in a process of its own. A row that one of the trees does not measure shows a dash there.
"""

from __future__ import annotations

import argparse
import compileall
import os
import re
import resource
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from statistics import median

HERE = Path(__file__).resolve().parents[2]
FIELDS, FLIR, LOOP = (f"tests/benchmarks/test_speed_{name}.py" for name in ("fields", "flir", "loop"))
JOINT = "tests/benchmarks/test_joint_estimate_speed.py"
ATTRIBUTION = "tests/benchmarks/test_speed_attribution.py"
#: The row of a run with which every kernel is compiled.
FIRST = "demo's `run`, first of an installation, s"
_NUMBER = r"([\d.]+(?:e-?\d+)?)"
#: A test of two hours with small pictures.
SMALL = """\
[campaign]
seed = 36

[test]
cycles = 36
targets = 9
spacing_mm = 37.5

[camera]
columns = 320
rows = 240
focal_px = 765.0

[[effect]]
name = "unseen_heat_source"
amplitude_um = 0.8
"""


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    work : str
        What is done, and what its figure is.
    test : str
        Benchmark that prints the figure.
    patterns : tuple of str
        Regular expressions of what the benchmark prints: the first that is found gives the figure by its group; two groups are a
        quotient, the second over the first.
    aim : str
        What the figure is to reach, and what limits it.
    """

    work: str
    test: str
    patterns: tuple[str, ...]
    aim: str


ROWS = (
    Row("SEQ of 500 frames to cycle fields with set-up, times flirpy", f"{FIELDS}::test_still_table_file_to_cycle_fields",
        (rf"Seq to temperature \(.*?\): {_NUMBER} \(",), "35"),
    Row("the same, share of summing the mapped file", f"{FIELDS}::test_still_table_file_to_cycle_fields",
        (rf"mapped file \(.*?frames/s\): {_NUMBER} \(",), "0.5; limit 1"),
    Row("5,000 frames, still, times flirpy", f"{FIELDS}::test_film_of_three_minutes", (rf"frames/s, {_NUMBER} \(.*?x flirpy",), "35"),
    Row("5,000 frames, still, share of summing the mapped file", f"{FIELDS}::test_film_of_three_minutes",
        (rf"x flirpy, {_NUMBER} \(",), "0.5; limit 1"),
    Row("moving table, 500 frames with set-up, times flirpy", f"{FIELDS}::test_moving_table", (rf"temperature: {_NUMBER} \(",), "15"),
    Row("moving table, 5,000 frames, times flirpy", f"{FIELDS}::test_film_of_three_minutes",
        (rf"moving .*frames/s, {_NUMBER} \(",), "15"),
    Row("cold file, share of a plain reader", f"{FIELDS}::test_cold_file", (rf"plain reader .*?: {_NUMBER} \(",), "0.9; limit 1"),
    Row("CSQ, share of imagecodecs' own rate, with set-up", f"{FIELDS}::test_jpegls_film_against_its_decoder_alone",
        (rf"imagecodecs alone {_NUMBER} \(",), "0.95; limit 1"),
    Row("two workers of a cluster, share of two threads, 20,000 frames", f"{FIELDS}::test_two_workers_against_two_threads",
        (rf"two threads {_NUMBER} \(",), "0.9"),
    Row("planning a day of 756,000 frames, s of processor", f"{FIELDS}::test_planning_a_day_of_video",
        (rf"planned in {_NUMBER} s",), "seconds"),
    Row("R-JPEG, raw, times flyr", f"{FLIR}::test_jpeg_to_temperature_against_flyr[raw]", (rf"ratio {_NUMBER}",), "200"),
    Row("R-JPEG, PNG 640 x 480, times flyr", f"{FLIR}::test_jpeg_to_temperature_against_flyr[png 640 x 480]", (rf"ratio {_NUMBER}",), "40"),
    Row("R-JPEG, PNG 128 x 96, times flyr", f"{FLIR}::test_jpeg_to_temperature_against_flyr[png 128 x 96]", (rf"ratio {_NUMBER}",), "40"),
    Row("folder of 100 R-JPEG, PNG 640 x 480, times flyr", f"{FLIR}::test_folder_of_jpegs_to_temperature_against_flyr[png 640 x 480]",
        (rf"frames/s, {_NUMBER} \(",), "40"),
    Row("10,000 headers as a Dataset, times flirpy", f"{FLIR}::test_opening_ten_thousand_frames_against_flirpy",
        (rf": {_NUMBER} and [\d.]+ times", rf"frames: {_NUMBER} s with all headers, flirpy {_NUMBER} s"), "20"),
    Row("10,000 headers as a list, times flirpy", f"{FLIR}::test_opening_ten_thousand_frames_against_flirpy",
        (rf"[\d.]+ and {_NUMBER} times",), "20"),
    Row("a day of 756,000 frames opened for the first time, s", f"{FLIR}::test_opening_a_day_of_video[756000]",
        (rf"warm: {_NUMBER} s",), "seconds"),
    Row("the same again, s", f"{FLIR}::test_opening_a_day_of_video[756000]", (rf"warm: .*?again {_NUMBER} s",), "seconds"),
    Row("loop, 5,000 cycles over 1,000", f"{LOOP}::test_time_and_memory_grow_with_the_cycles",
        (rf"loop {_NUMBER} times the time",), "5.5"),
    Row("peak memory of 5,000 cycles, MB", f"{LOOP}::test_time_and_memory_grow_with_the_cycles",
        (rf"30000 readings.* {_NUMBER} MB",), "1000"),
    Row("run of 12 cycles at 400 targets over 300 at 16",
        f"{LOOP}::test_time_grows_with_the_readings_not_with_a_power_of_the_targets",
        (rf"run {_NUMBER},",), "2"),
    Row("screen, 1,000 permutations, times nilearn permuted_ols", f"{ATTRIBUTION}::test_against_nilearn",
        (rf"permuted_ols / screen = {_NUMBER}",), "15"),
    Row("restricted likelihood of 960 readings, times statsmodels", f"{JOINT}::test_one_likelihood_against_statsmodels",
        (rf"loglike / ours = {_NUMBER}",), "10"),
    Row("SEQ to cycle fields, times xarray's means of pictures in memory",
        f"{FIELDS}::test_file_to_cycle_fields_against_means_by_xarray", (rf"in memory .*?: {_NUMBER} \(",), "1"),
)  # fmt: skip


def main() -> None:
    """Measure both trees in turns and print the table; it is kept in build/speeds.md as it grows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("before", type=Path, help="checkout of the earlier state")
    parser.add_argument(
        "--turns", type=int, default=3, help="of the commands; a benchmark takes its own turns with its peers"
    )
    given = parser.parse_args()
    trees = (given.before.resolve(), HERE)
    kept = HERE / "build" / "speeds.md"
    kept.parent.mkdir(exist_ok=True)
    lines = ["| work | before | now | aim |", "|---|---|---|---|"]
    for line in chain(commands(trees, given.turns), benchmarks(trees)):
        lines.append(line)
        kept.write_text("\n".join(lines) + "\n")
        print(line, flush=True)


def benchmarks(trees: Sequence[Path]) -> Iterator[str]:
    """Run each benchmark in both trees, one after the other; yield the rows."""
    for test in dict.fromkeys(row.test for row in ROWS):
        told = [printed(tree, test) for tree in trees]
        for row in (row for row in ROWS if row.test == test):
            before, now = (figure(row, text) for text in told)
            yield f"| {row.work} | {before} | {now} | {row.aim} |"


def printed(tree: Path, test: str) -> str:
    """What a benchmark of a tree prints; nothing where the tree has not got it."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-m", "slow or not slow", "--benchmark-enable", "-q", "-s", "-p", "no:cacheprovider", test],
        cwd=tree, env=environment(tree), capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.stdout


def figure(row: Row, text: str) -> str:
    """The figure of a row in what was printed, or a dash."""
    for pattern in row.patterns:
        if found := re.search(pattern, text):
            values = [float(value) for value in found.groups()]
            return f"{values[0] if len(values) == 1 else values[1] / values[0]:.3g}"
    return "–"


def commands(trees: Sequence[Path], turns: int) -> Iterator[str]:
    """Time commands of both trees by the clock; yield the rows."""
    works: dict[str, tuple[Callable[[Path], list[str]], str]] = {
        FIRST: (lambda folder: ["run", campaign_of(folder), "--out", str(folder / "results")], "1.3 times a later one"),
        "`thermofuse --help`, s": (lambda folder: ["--help"], "0.2"),
        "`inspect` of one radiometric JPEG, s": (lambda folder: ["inspect", str(frames_of(folder))], "0.65"),
        "`check` of the demo, s": (lambda folder: ["check", campaign_of(folder)], "1"),
        "demo's `run`, s": (lambda folder: ["run", campaign_of(folder), "--out", str(folder / "results")], "4"),
        "`run` of 36 cycles, 9 targets, pictures of 320 x 240, s": (
            lambda folder: ["run", str(folder / "small" / "campaign.toml"), "--out", str(folder / "of_small")], "3"
        ),
        "`--resume` of the finished run, s": (
            lambda folder: ["run", campaign_of(folder), "--out", str(folder / "results"), "--resume"], "2.05"
        ),
        "`report` made anew, s": (lambda folder: ["report", str(folder / "results")], "1.5 and loading"),
    }  # fmt: skip
    folders = [HERE / "build" / "speeds" / name for name in ("before", "now")]
    small = HERE / "build" / "speeds" / "small.toml"
    small.parent.mkdir(parents=True, exist_ok=True)
    small.write_text(SMALL, encoding="utf-8")
    for tree, folder in zip(trees, folders, strict=True):
        for package in ("thermofuse", "fusion", "thermography", "interferometry"):
            compileall.compile_dir(tree / package, quiet=1)
        shutil.rmtree(folder, ignore_errors=True)
        for recipe, name in ((HERE / "data" / "recipes" / "demo.toml", "campaign"), (small, "small")):
            timed(tree, ["simulate", str(recipe), "--out", str(folder / name)], compiled=folder / "of_twin")
    for work, (arguments, aim) in works.items():
        seconds: list[list[tuple[float, float]]] = [[], []]
        # The first turn of each compiles, and fills the page cache: it is what is asked for once, and left out otherwise.
        for turn in range(1 if work == FIRST else turns + 1):
            for tree, folder, kept in zip(trees, folders, seconds, strict=True):
                if "--out" in (asked := arguments(folder)) and "--resume" not in asked:
                    shutil.rmtree(asked[asked.index("--out") + 1], ignore_errors=True)
                spent = timed(tree, asked, compiled=folder / "kernels")
                if turn or work == FIRST:
                    kept.append(spent)
        before, now = (
            f"{median(wall for wall, _ in kept):.2f}; processor {median(cpu for _, cpu in kept):.2f}"
            for kept in seconds
        )
        yield f"| {work} | {before} | {now} | {aim} by the clock |"


def campaign_of(folder: Path) -> str:
    """The campaign file of the demo."""
    return str(folder / "campaign" / "campaign.toml")


def frames_of(folder: Path) -> Path:
    """A file of frames of the demo."""
    return min((folder / "campaign" / "thermal").iterdir())


def timed(tree: Path, arguments: list[str], *, compiled: Path) -> tuple[float, float]:
    """Wall and processor time of a command of a tree, s; kernels that are compiled are kept in a folder."""
    script = tomllib.loads((tree / "pyproject.toml").read_text())["project"]["scripts"]["thermofuse"]
    module, _, name = script.partition(":")
    start = f"import sys; from {module} import {name}; sys.argv[0] = 'thermofuse'; sys.exit({name}())"
    wall, used = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, "-P", "-c", start, *arguments],
        cwd=tree, env={**environment(tree), "NUMBA_CACHE_DIR": str(compiled)}, check=True, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    wall, after = time.perf_counter() - wall, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime


def environment(tree: Path) -> dict[str, str]:
    """Variables with which a tree finds its own modules."""
    return {**os.environ, "PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}


if __name__ == "__main__":
    main()
