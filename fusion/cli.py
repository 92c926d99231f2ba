"""The command line, a function for each command. How it ends is in `fusion.common.messages`."""

from __future__ import annotations

import io
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from enum import StrEnum
from functools import partial, reduce
from importlib import import_module, metadata
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from typer import Argument, Option
from typer.core import TyperGroup

from fusion.common import CAMPAIGN_FILE, NO_PLUGINS, campaign_file
from fusion.common.messages import (
    ExitCode,
    Terminal,
    answering,
    failed_code,
    interrupt_ends_step,
    leave,
    print_json,
    printable,
)
from fusion.pipeline.workers import collect_garbage_less, second_process

if TYPE_CHECKING:
    from fusion.results.progress import Report
    from fusion.results.results import Results


#: Commands of a first day, in the order in which they are needed; help shows the others after them.
_FIRST = ("demo", "app", "init", "check", "run", "report", "inspect")


class _Commands(TyperGroup):
    """The commands, none of which takes an empty argument."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands in the order in which help shows them."""
        return [*_FIRST, *sorted(set(self.commands) - set(_FIRST))]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands of a first day, then the others."""
        for title, names in (("Commands", _FIRST), ("More", self.list_commands(ctx)[len(_FIRST) :])):
            with formatter.section(title):
                width = formatter.width - 6 - max(map(len, self.commands))
                formatter.write_dl([(name, self.commands[name].get_short_help_str(width)) for name in names])

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Refuse an empty argument, which a path would take for the present folder."""
        for before, one in pairwise(["thermofuse", *args]):
            if one == "" or re.fullmatch("--[a-z-]+=", one):
                empty = one or f"after {before}"
                raise typer.BadParameter(
                    f"the argument {empty} is empty; write it, or leave it out (is a variable of the shell not set?)"
                )
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_Commands, no_args_is_help=True, add_completion=True, pretty_exceptions_enable=False, rich_markup_mode=None
)
console = Terminal()
errors = Terminal(stderr=True, soft_wrap=True)
#: Groups of entry points under which other packages offer effects and readers.
_PLUGINS = {"thermofuse.effects", "thermofuse.frame_readers"}
#: The longest time to wait for data, s.
_YEAR_S = 365 * 86400.0
#: Characters of a line of a wide table where the output is no terminal.
_TABLE_WIDTH = 160


#: What `export` can write.
_FORMATS = (
    "csv, xlsx, png, gif, mp4, linuxcnc, siemens840d, siemens840d-temperature, heidenhain, twincat, model-json, model-c, model-st, "
    "model-linuxcnc"
)


class FrameFormat(StrEnum):
    """What `inspect` can write of thermal frames."""

    png = "png"
    tiff = "tiff"
    csv = "csv"
    gif = "gif"
    mp4 = "mp4"
    table = "table"


#: Arguments and options that several commands have.
Quiet = Annotated[bool, Option("--quiet", "-q", help="Print errors only.")]
ResultsFolder = Annotated[Path, Argument(metavar="RESULTS", help="Results folder of a run.")]


def _answering(folders: Sequence[Path] = ()) -> AbstractContextManager[None]:
    """End a command as `fusion.common.messages` says; `folders` are those of its results."""
    return answering(errors, kept=lambda: _kept(folders))


def _print_lines(lines: Iterable[str]) -> None:
    """Print lines that a terminal wraps."""
    for line in lines:
        console.print(line, soft_wrap=True)


def _wide() -> Terminal:
    """Return the console for a table of many columns: a file or a pipe, which has no width of its own, gets it on one line."""
    return console if console.is_terminal else Terminal(width=_TABLE_WIDTH)


def _refuse(why: str) -> NoReturn:
    """End a command that cannot be done."""
    errors.print(f"thermofuse: {why}")
    raise typer.Exit(ExitCode.BAD_INPUT)


def _end_unless(equal: bool) -> None:
    """End a command whose answer is that something differs from what it should be."""
    if not equal:
        raise typer.Exit(ExitCode.DIFFERENT)


def _kept(folders: Sequence[Path]) -> str:
    """Say what a stopped run leaves in its folders, and how to go on."""
    if not folders:
        return ""
    from fusion.results.store import finished_stages

    kept = [f"{folder} keeps {', '.join(finished_stages(folder)) or 'no finished stage'}" for folder in folders]
    return f"{'; '.join(kept)}; start the same command with --resume to go on"


def _print_version(requested: bool) -> None:
    """Print name and version and stop, where asked."""
    if requested:
        console.print(f"thermofuse {metadata.version('thermofuse')}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """Explain the thermal drift of a machine-tool axis from FLIR frames and laser readings."""


@app.command()
def run(
    campaigns: Annotated[
        list[str],
        Argument(
            metavar="CAMPAIGN.toml...",
            help="One campaign file, its folder or its address (s3://, https://), or two of one machine.",
        ),
    ],
    out: Annotated[
        Path | None,
        Option(
            help="Results folder; left out: 'results' next to the campaign file, or here for an address or two campaigns."
        ),
    ] = None,
    resume: Annotated[bool, Option("--resume", help="Continue a run that is in the results folder.")] = False,
    scheduler: Annotated[str | None, Option(metavar="ADDRESS", help="dask scheduler for the per-frame work.")] = None,
    no_plugins: Annotated[
        bool, Option("--no-plugins", help="Leave out effects that other installed distributions add.")
    ] = False,
    watch: Annotated[
        bool,
        Option(
            "--watch", help="First follow the test while its files grow, a line per cycle; Ctrl-C ends it, then run."
        ),
    ] = False,
    until_idle: Annotated[
        float | None,
        Option(
            metavar="SECONDS",
            min=0.0,
            max=_YEAR_S,
            help="With --watch: the test has ended when no data have arrived for this time.",
        ),
    ] = None,
    wanted: Annotated[
        str, Option(metavar="U", help="With --watch: wanted standard uncertainty of a position.")
    ] = "0.1 um",
    processes: Annotated[int, Option(min=1, max=2, help="2: a second process shares the work.")] = 2,
    details: Annotated[bool, Option("--details", help="Print every finding, not the first ones alone.")] = False,
    quiet: Quiet = False,
    json_progress: Annotated[bool, Option("--json-progress", hidden=True)] = False,
) -> None:
    """Run the whole pipeline on a campaign.

    Temperature maps, drift, anomalies, the closed loop, and report.html.
    """
    if len(campaigns) > 2:
        _refuse("one campaign, or two of one machine, can be analysed at a time")
    if watch and len(campaigns) > 1:
        _refuse("one campaign can be watched at a time")

    places = [_place(text) for text in campaigns]
    folders = _folders(places, out)
    if no_plugins:
        os.environ[NO_PLUGINS] = "1"
    written, progress = [folder for _, folder in folders], partial(_progress, quiet=quiet, json_progress=json_progress)
    # The libraries may take seconds to load: something is seen before that. Nothing is written yet, and a library whose loading a signal
    # broke off cannot be loaded to say so.
    with _answering(), progress() as report:
        report("start", 0, 1)
        from fusion.report.findings import brief_table, summary_table

        # For a run that is whole the libraries of the analysis are not loaded.
        kept = [_read_whole(*one) if resume and not watch else None for one in folders]
        two = processes > 1 and not watch and None in kept
        # What both processes need is loaded before there are two.
        for name in ("fusion.pipeline.run", "numba") if two else ():
            import_module(name)
        report("start", 1, 1)
    with second_process(wanted=two) as worker, _answering(written):
        if watch:
            _watch(_here(places[0], "--watch follows"), until_idle_s=until_idle, wanted=wanted, quiet=quiet)
        if len(folders) == 2:
            from fusion.pipeline.compare import compare_runs, require_one_kind

            require_one_kind([_here(place, "two are joined from") for place in places])
        for (campaign, folder), results in zip(folders, kept, strict=True):
            with progress() as report:
                if results is None:
                    from fusion.pipeline.run import run_campaign

                    results = run_campaign(
                        campaign, folder, resume=resume, scheduler=scheduler, report=report, worker=worker
                    )
                else:
                    report("run (kept)", 1, 1)
            if not quiet:
                console.print(summary_table(results) if details else brief_table(results))
                console.print(f"report: {(folder / 'report.html').resolve()}", soft_wrap=True)
        if len(folders) == 2:
            for name, text in compare_runs(written, folders[0][1].parent):
                if not quiet:
                    console.print(f"both campaigns, {name}: {text}", soft_wrap=True)


def _watch(campaign: Path, *, until_idle_s: float | None, wanted: str, quiet: bool) -> None:
    """Follow a test until it is over, a line per finished cycle."""
    from fusion.campaign.config import CampaignError, load_campaign
    from fusion.campaign.values import read_option
    from fusion.pipeline.watch import follow, live_line

    wanted_u_um = read_option("--wanted", wanted, "um")
    if not wanted_u_um > 0.0:
        raise CampaignError(f'--wanted "{wanted}": the wanted uncertainty must be above 0; write for example "0.1 um"')
    with interrupt_ends_step() as requested:
        states = follow(load_campaign(campaign), until_idle_s=until_idle_s, wanted_u_um=wanted_u_um, stop=requested)
        for state in states:
            for warning in state.warnings:
                errors.print(f"thermofuse: {warning}")
            if state.cycle is not None and not quiet:
                console.print(live_line(state), soft_wrap=True)


def _read_whole(campaign: Path | str, folder: Path) -> Results | None:
    """Read the results of a run that is whole; None where anything has to be done."""
    if isinstance(campaign, str):
        return None
    from fusion.campaign.config import load_campaign
    from fusion.pipeline.resume import kept_results

    return kept_results(load_campaign(campaign), folder)


@contextmanager
def _progress(*, quiet: bool, json_progress: bool = False) -> Iterator[Report]:
    """Show the progress of what is done within, or nothing; as JSON for a program that reads it."""
    from fusion.results.progress import Reporter, silent, write_lines

    if quiet or json_progress:
        yield write_lines if json_progress else silent
        return
    with Reporter(console) as report:
        yield report


def _place(text: str) -> Path | str:
    """Return an address as it is written, anything else as a path: of a folder, that of the campaign file in it."""
    return text if "://" in text else campaign_file(Path(text))


def _here(place: Path | str, what: str) -> Path:
    """Return a path; refuse an address, which `what` cannot use."""
    if isinstance(place, str):
        from fusion.campaign.remote import RemoteError

        raise RemoteError(f"{place}: {what} campaigns of this machine; name a path")
    return place


def _folders(campaigns: list[Path | str], out: Path | None) -> list[tuple[Path | str, Path]]:
    """Return each campaign with its results folder; two share `out` as subfolders named after the folders of their files."""
    if len(campaigns) == 1:
        parent = Path() if isinstance(campaigns[0], str) else campaigns[0].parent
        return [(campaigns[0], out or parent / "results")]
    names = [Path(path).absolute().parent.name for path in campaigns]
    unique = names if len(set(names)) == len(names) else [f"{name}_{k}" for k, name in enumerate(names, start=1)]
    base = out or Path("results")
    return [(path, base / name) for path, name in zip(campaigns, unique, strict=True)]


@app.command()
def fleet(
    paths: Annotated[
        list[Path],
        Argument(metavar="FOLDER|CAMPAIGN.toml...", help="Campaign files, or folders with a campaign.toml in each."),
    ],
    out: Annotated[Path, Option(help="Folder for the summary and the results of every campaign.")] = Path("fleet"),
    jobs: Annotated[
        int | None, Option(min=1, help="Most campaigns at a time; left out: one per processor, as memory allows.")
    ] = None,
    resume: Annotated[
        bool, Option("--resume", help="Keep campaigns that are finished and unchanged, continue the others.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Run many campaigns, one process for each.

    Writes fleet.html, fleet.xlsx, fleet.csv and fleet.json with a row for each. One that fails does not stop the others; exit code 100 and
    the number that failed.
    """
    from fusion.pipeline.fleet import find_members, run_fleet
    from fusion.report.fleet import Row, count_line, read_rows, summary_table

    def kept() -> str:
        return f"{out}: {count_line([*read_rows(out).values()])}; start the same command with --resume to go on"

    def say(row: Row) -> None:
        what = row.message if row.state == "failed" else row.headline or row.state
        (errors if row.state == "failed" else console).print(f"{row.name}: {what}", soft_wrap=True)

    with answering(errors, kept=kept):
        members = find_members(paths)
        with _progress(quiet=quiet) as report:
            said = (lambda row: say(row) if row.state == "failed" else None) if quiet else say
            rows = run_fleet(members, out, jobs=jobs, resume=resume, report=report, say=said)
        if not quiet:
            _wide().print(summary_table(rows, count_line(rows)))
            console.print(f"summary: {(out / 'fleet.html').resolve()}", soft_wrap=True)
        failed = sum(row.state == "failed" for row in rows)
        if failed:
            raise typer.Exit(failed_code(failed))


@app.command()
def init(
    folder: Annotated[
        Path, Argument(metavar="FOLDER", help="Folder with the files of one measurement, or of several laser tests.")
    ],
    yes: Annotated[
        bool, Option("--yes", "-y", help="Do not ask: leave marked lines to fill in for what the files do not contain.")
    ] = False,
) -> None:
    """Write a commented campaign file for a folder.

    Its files are inspected, what they do not contain is asked for, and the result is checked; exit code 2 where it is not ready to run. Of
    several laser tests without frames each gets a folder with a campaign file, which fleet runs. An existing campaign.toml is never
    replaced.
    """
    from fusion.campaign.draft import Asker, DraftError, unused_files, write_campaigns
    from fusion.pipeline.check import check_campaign
    from fusion.results.progress import counted

    def ask(question: str, default: str) -> str:
        shown = printable(f"{question} [{default}]" if default else question)
        return str(typer.prompt(shown, default=default, show_default=False))

    with _answering():
        if not yes and not sys.stdin.isatty():
            raise DraftError("there is no terminal to ask at; add --yes, which leaves marked lines to fill in")
        written, ready = write_campaigns(folder, Asker(None if yes else ask, errors.print)), 0
        several = len(written) > 1
        _print_lines(dict.fromkeys(f"not used: {line}" for path, _ in written for line in unused_files(path)))
        for path, missing in written:
            console.print(f"campaign: {path.resolve()}", soft_wrap=True)
            if missing:
                _print_lines(f"to fill in, {line}" for line in missing)
                console.print(f"not ready: {counted(len(missing), 'line')} to fill in")
                continue
            checked = check_campaign(path)
            _print_lines(checked.lines(brief=several))
            ready += not checked.faults
        if several:
            then = f"thermofuse fleet {folder} gives a report of each and one table"
            console.print(f"{ready} of {len(written)} tests are ready to run; {then}", soft_wrap=True)
        if ready < len(written):
            raise typer.Exit(ExitCode.BAD_INPUT)


@app.command("app")
def application(
    folder: Annotated[
        Path | None, Argument(metavar="FOLDER", help="Folder that it may read and write; left out: the present one.")
    ] = None,
    port: Annotated[int, Option(min=0, max=65535, help="Port on this machine; 0: a free one.")] = 0,
    open_browser: Annotated[bool, Option("--open", help="Open it in the browser of this system.")] = False,
) -> None:
    """Set a campaign up and run it in the browser.

    The application answers on this machine only, to whoever opens the printed address; it uses no network.
    """
    from fusion.app.server import serve

    with _answering():
        serve(
            folder or Path.cwd(),
            port=port,
            open_browser=open_browser,
            say=lambda address: console.print(f"app: {address}", soft_wrap=True),
        )


@app.command()
def check(
    campaign: Annotated[
        str, Argument(metavar="CAMPAIGN.toml", help="The campaign file, its folder, or its address (s3://, https://).")
    ],
    as_json: Annotated[bool, Option("--json", help="Print one JSON object.")] = False,
    quiet: Annotated[bool, Option("--quiet", "-q", help="Print faults and doubts only.")] = False,
) -> None:
    """Check a campaign without running it.

    The file, the files that it names, clocks and overlap, the axis on the plan, a few frames; exit code 2 where run would refuse it.
    """
    from fusion.pipeline.check import check_campaign

    with _answering():
        place, with_address = _fetched(campaign, whole=True, quiet=quiet or as_json)
        checked = check_campaign(place)
        if as_json:
            print_json(checked.as_json(), with_address)
        else:
            _print_lines(map(with_address, checked.lines(quiet=quiet)))
        if checked.faults:
            raise typer.Exit(ExitCode.BAD_INPUT)


def _fetched(text: str, *, whole: bool, quiet: bool) -> tuple[Path, Callable[[str], str]]:
    """Return a path as it is; of an address, the file that was fetched, or the `whole` campaign, and what puts the address in messages."""
    if "://" not in text:
        return Path(text), lambda line: line
    from fusion.campaign.remote import fetch_campaign, fetch_file

    with _progress(quiet=quiet) as report:
        mirror = (fetch_campaign if whole else fetch_file)(text, report=report)
    if not quiet:
        errors.print(mirror.line())
    return mirror.path, mirror.with_address


@app.command()
def reproduce(
    results: Annotated[Path, Argument(metavar="RESULTS", help="Results folder of a finished run; only read.")],
    campaign: Annotated[
        str | None, Option(help="The campaign file or its address; left out: where the run found it.")
    ] = None,
) -> None:
    """Compute a run again and tell whether its results are equal, byte for byte.

    Exit code 0 where they are, 1 where inputs or results differ.
    """
    from fusion.pipeline.reproduce import reproduce as compute_again

    with _answering():
        with _progress(quiet=False) as report:
            found = compute_again(results, campaign=None if campaign is None else _place(campaign), report=report)
        _print_lines(found.lines)
        _end_unless(found.equal)


@app.command()
def simulate(
    recipe: Annotated[
        Path, Argument(metavar="RECIPE.toml", help="What the machine of the twin does; or demo, paper, record.")
    ],
    out: Annotated[Path, Option(help="Folder of the campaign; must be empty or absent.")],
) -> None:
    """Simulate a campaign with known truth.

    Writes the files that the instruments would write; the truth is kept next to the folder.
    """
    from fusion.twin.instruments import simulate_campaign

    with _answering(), _progress(quiet=False) as report:
        simulate_campaign(recipe, out, progress=lambda done, total, what: report(what, done, total))
        console.print(f"campaign: {(out / CAMPAIGN_FILE).resolve()}", soft_wrap=True)


@app.command()
def demo(
    out: Annotated[Path, Argument(metavar="FOLDER", help="Folder to write, which must be empty or absent.")] = Path(
        "demo"
    ),
) -> None:
    """Simulate a campaign of known truth and run it: the first report in a minute, without files of one's own."""
    simulate(Path("demo"), out)
    run([str(out)], out=out / "results")


@app.command()
def inspect(
    paths: Annotated[
        list[str],
        Argument(
            metavar="FILE|FOLDER...",
            help="Any file that a run reads or its address (s3://, https://), or folders of them.",
        ),
    ],
    export: Annotated[Path | None, Option(help="Folder for the thermal frames as pictures and tables.")] = None,
    formats: Annotated[
        list[FrameFormat] | None,
        Option(
            "--as",
            help="png with scale, tiff or csv of the temperatures, a film, the table of regions; left out: png and table.",
        ),
    ] = None,
    as_json: Annotated[bool, Option("--json", help="Print one JSON object.")] = False,
    quiet: Annotated[bool, Option("--quiet", "-q", help="Print faults and warnings only.")] = False,
) -> None:
    """Print what files hold, with warnings about implausible content.

    A series of frames is summed up. A file that cannot be used is named and does not stop the others; the exit code is 2 where it was named
    here, or is of a known kind, or where nothing can be used.
    """
    from fusion.campaign.inspect import inspect_paths, write_frames

    with _answering():
        looked_into = []
        fetched = [_fetched(text, whole=False, quiet=quiet or as_json) for text in paths]
        places = [place for place, _ in fetched]

        def with_address(line: str) -> str:
            return reduce(lambda text, name: name(text), (name for _, name in fetched), line)

        for one in inspect_paths(places):
            looked_into.append(one)
            if not as_json:
                _print_lines(map(with_address, one.shown(quiet=quiet)))
        if export is not None:
            written = [f"  {line}" for line in write_frames(places, export, formats or ["png", "table"])]
            _print_lines([] if quiet or as_json else written)
        if as_json:
            print_json({"files": [one.as_json() for one in looked_into]}, with_address)
        if any(one.fails for one in looked_into) or all(one.fault for one in looked_into):
            raise typer.Exit(ExitCode.BAD_INPUT)


@app.command()
def iso230(
    test: Annotated[
        Path,
        Argument(
            metavar="FILE|CAMPAIGN.toml|RESULTS",
            help="Deviations (.rtl, a table as text, XLSX or ODS, a log of a positioning test), a campaign file, or a results folder.",
        ),
    ],
    cycles: Annotated[
        str | None,
        Option(
            help="Window, for example 1-5; left out: the cycles under [acceptance] of the campaign file, without them the last five "
            "whole cycles."
        ),
    ] = None,
    out: Annotated[Path | None, Option(help="Write the sheet to sign: sheet.html, sheet.pdf, or sheet.docx.")] = None,
    as_json: Annotated[bool, Option("--json", help="Print everything as JSON.")] = False,
    as_csv: Annotated[bool, Option("--csv", help="Print the values per target as CSV.")] = False,
) -> None:
    """Evaluate a test by ISO 230-2.

    A campaign file adds uncertainties, tolerances and the conditions of the test.
    """
    from fusion.pipeline.iso230 import read_test
    from fusion.report import sheet as pages
    from fusion.report.wording import sentences

    if as_json and as_csv:
        _refuse("--json and --csv: what is printed has one format; write one of them")
    with _answering():
        if out is not None:
            # A long test takes a minute; a name that cannot be written is told before.
            pages.page_format(out, *pages.SHEET_FORMATS)
        found = read_test(test, cycles)
        if as_json:
            print_json(pages.iso230_json(found.part, found.dataset))
        elif as_csv:
            sys.stdout.write(pages.iso230_csv(found.dataset))
        else:
            for table in pages.iso230_tables(found.part, found.dataset, title=found.title, axis_alone=out is not None):
                _wide().print(table)
            _print_lines([*sentences("decided_how", found.part), *found.remarks])
        if out is not None:
            sheet = pages.describe_sheet(found.title, found.part, files=found.files, own=found.sheet)
            pages.write_iso230(out, sheet, found.part, found.dataset, remarks=found.remarks)
            errors.print(f"page: {out.resolve()}")


@app.command()
def verify(
    before: Annotated[
        Path, Argument(metavar="BEFORE", help="Results folder of the test that the model was made from.")
    ],
    after: Annotated[Path, Argument(metavar="AFTER.toml", help="Campaign file of the test with the compensation.")],
    applied: Annotated[Path, Option(metavar="MODEL.json", help="The model that the control runs.")],
    out: Annotated[Path | None, Option(help="Write the sheet to sign: sheet.html, .pdf or .docx.")] = None,
    as_json: Annotated[bool, Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Compare the test after a compensation with what was predicted.

    What was predicted with its interval, what was achieved, and why not: wrong sign or scale, other coefficients, a dead sensor. Exit code
    0 where every displacement is as predicted, else 1.
    """
    from dataclasses import asdict

    from fusion.pipeline.plan import verify_compensation
    from fusion.report.campaign import verification_table
    from fusion.report.sheet import write_verification
    from fusion.report.wording import print_table

    with _answering():
        found = verify_compensation(before, after, applied)
        if as_json:
            print_json({key: value for key, value in asdict(found).items() if key != "test"})
        else:
            title = f"{found.before}, then {found.after}: range of the drift"
            _wide().print(print_table(verification_table(found.channels), title))
            _print_lines(
                [*(f"{one.name}: {one.fault}: {one.reason}" for one in found.channels if one.fault), *found.remarks]
            )
        if out is not None:
            write_verification(out, found.after, found.channels, found.remarks, *found.test)
            errors.print(f"page: {out.resolve()}")
        _end_unless(all(one.is_kept for one in found.channels))


@app.command("iso230-3")
def iso230_3(
    test: Annotated[
        Path,
        Argument(
            metavar="CAMPAIGN.toml|RESULTS",
            help="A campaign file with a [record] or readings of a linear axis, or a results folder.",
        ),
    ],
    out: Annotated[Path | None, Option(help="Write the sheet to sign: sheet.html, .pdf or .docx.")] = None,
    as_json: Annotated[bool, Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Evaluate a test of thermal effects by ISO 230-3.

    Distortion in the first and the last hour and over the whole test, tilts, drift of zero and scale, settling time.
    """
    from fusion.pipeline.iso230_3 import read_thermal_tests
    from fusion.report.campaign import thermal_test_tables
    from fusion.report.sheet import write_thermal_tests

    with _answering():
        title, tests, files, own = read_thermal_tests(test)
        if as_json:
            print_json([one.model_dump(mode="json") for one in tests])
        else:
            for table in thermal_test_tables(tests, title=title):
                _wide().print(table)
            _print_lines(dict.fromkeys(line for one in tests for line in one.remarks))
        if out is not None:
            write_thermal_tests(out, title, tests, files=files, own=own)
            errors.print(f"page: {out.resolve()}")


@app.command()
def schema(
    name: Annotated[str, Argument(metavar="results|campaign|recipe", help="Which file to describe.")] = "results",
) -> None:
    """Print the JSON Schema of a file."""
    from fusion.campaign.config import campaign_schema
    from fusion.results.results import results_schema
    from fusion.twin.recipe_file import recipe_schema

    schemas = {"results": results_schema, "campaign": campaign_schema, "recipe": recipe_schema}
    if name not in schemas:
        _refuse(f'there is no schema "{name}"; write results, campaign or recipe')
    with _answering():
        print_json(schemas[name]())


@app.command()
def export(
    results: ResultsFolder,
    format: Annotated[str, Option("--format", metavar="FORMAT", help=f"What to write: {_FORMATS}.")],
    out: Annotated[Path | None, Option(help="Folder for the files; left out: RESULTS/export.")] = None,
    axis: Annotated[str | None, Option(help="Name of the axis in the control; left out: the campaign's axis.")] = None,
    spacing: Annotated[
        str | None, Option(help='Largest distance of equally spaced points, "25 mm"; left out: the targets.')
    ] = None,
    reference: Annotated[
        str | None,
        Option(help='Position at which the correction is zero; left out: "0 mm" or the target nearest to it.'),
    ] = None,
    active: Annotated[
        str | None,
        Option(
            metavar="TABLE|none",
            help="The control's table that was active during the test, to which what was measured is added; left out: as stated.",
        ),
    ] = None,
    sampling: Annotated[str, Option(help="With model-...: time from step to step of the control.")] = "1 s",
    reduced: Annotated[bool, Option("--reduced", help="With model-...: the fewest sensors that suffice.")] = False,
    fields: Annotated[bool, Option("--fields", help="With csv: the fields too, a large file.")] = False,
    force: Annotated[
        bool, Option("--force", help="Write a compensation even if the results do not support it.")
    ] = False,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace files that exist.")] = False,
) -> None:
    """Export tables, a workbook, maps of every cycle as pictures or as a film, or a control's compensation.

    A compensation table is written where the drift is explained and the inputs are sound, with a header that says in which thermal
    state it holds and how to try it.
    """
    from fusion.campaign.values import read_option
    from fusion.report.exports.export import export_results
    from fusion.results.folder import own_place

    with _answering():
        exported = export_results(
            results,
            format,
            out or own_place(results, "export"),
            axis=axis,
            spacing_mm=None if spacing is None else read_option("--spacing", spacing, "mm"),
            reference_mm=None if reference is None else read_option("--reference", reference, "mm"),
            active=active,
            sampling_s=read_option("--sampling", sampling, "s"),
            reduced=reduced,
            fields=fields,
            force=force,
            overwrite=overwrite,
        )
        for remark in exported.remarks:
            errors.print(f"thermofuse: {remark}")
        _print_lines(map(str, exported.files))


@app.command()
def report(
    results: ResultsFolder,
    pdf: Annotated[bool, Option("--pdf", help="Print it to PDF with an installed Chrome, Chromium or Edge.")] = False,
    out: Annotated[
        Path | None,
        Option(
            help="File to write, .html or .pdf, which must not exist; left out: report.html or report.pdf in RESULTS."
        ),
    ] = None,
    browser: Annotated[
        str | None, Option(help="With --pdf: the browser that prints; left out: one is looked for.")
    ] = None,
) -> None:
    """Make the report of a finished run again, or print it to PDF."""
    from fusion.report.page import page_format, print_pdf, report_of
    from fusion.results.folder import claim_file
    from fusion.results.store import StageStamps, write_text

    with _answering():
        if out is not None:
            pdf = page_format(out, *([".pdf"] if pdf else [".html", ".pdf"])) == ".pdf"
        page = report_of(results)
        file = claim_file(results, "report.pdf" if pdf else "report.html", out)
        written = print_pdf(page, file, browser=browser) if pdf else write_text(file, page)
        if out is None and not pdf:
            # The run stays whole: `run --resume` has nothing to do.
            StageStamps(results).renew(file)
        console.print(str(written), soft_wrap=True)


@app.command()
def compare(
    results: Annotated[
        list[Path],
        Argument(metavar="RESULTS RESULTS...", help="Results folders of one machine; the first is the reference."),
    ],
    out: Annotated[Path | None, Option(help="Write the comparison as a document, page.html or page.pdf.")] = None,
    same_setup: Annotated[
        bool,
        Option("--same-setup", help="Laser, its alignment and the sensors stood untouched: their errors are common."),
    ] = False,
    applied: Annotated[
        Path | None,
        Option(metavar="TABLE", help="The exported table that was loaded between two tests: predicted and achieved."),
    ] = None,
    as_json: Annotated[bool, Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Compare campaigns of one machine: what changed by more than the uncertainties.

    Profile, scatter, drift per kelvin, ISO 230-2 values and positions that stand out, each campaign against the first. With --applied the
    exit code is 0 where the table acted as it states and the machine did not change, else 1.
    """
    from fusion.pipeline.compare import compare_campaigns
    from fusion.pipeline.iso230 import sheet_of_run
    from fusion.report import comparison as compared
    from fusion.report.charts.comparison import follow_trends
    from fusion.report.page import write_page
    from fusion.report.wording import print_table

    with _answering():
        pairs = compare_campaigns(results, same_setup=same_setup, applied=applied)
        if out is not None:
            write_page(out, compared.render_comparison(pairs, own=sheet_of_run(results[-1])))
            errors.print(f"page: {out.resolve()}")
        if as_json:
            print_json(compared.comparison_json(pairs))
            _end_unless(pairs[0].is_kept)
            return
        wide, names = _wide(), compared.campaign_names(pairs)
        wide.print(print_table(compared.side_by_side(pairs), "; ".join(names)))
        for name, pair in zip(names[1:], pairs, strict=True):
            if pair.changes:
                wide.print(print_table(compared.changes_table(pairs, pair), f"{names[0]} -> {name}"))
            if pair.achieved:
                wide.print(print_table(compared.achieved_table(pair), "Predicted and achieved"))
            found = compared.describe_places(pairs, pair)
            if found and found["table"].rows:
                wide.print(print_table(found["table"], "Places that the drift follows"))
            _print_lines([*compared.conclude_table(pair), compared.conclude_comparison(pair), *found.get("said", ())])
        _print_lines([*compared.trend_sentences(follow_trends(pairs)), *compared.comparison_notes(pairs)])
        _end_unless(pairs[0].is_kept)


@app.command()
def plan(
    results: Annotated[
        Path | None,
        Argument(metavar="[RESULTS]", help="Results of a record: what it left open asks for the next test."),
    ] = None,
    source: Annotated[
        list[str], Option(metavar="NAME=TIME", help="A heat source that can be switched, with its time constant.")
    ] = [],  # noqa: B006
    effect: Annotated[str, Option(help="Smallest drift of one source to be detected.")] = "1 um",
    drift: Annotated[
        str, Option(help="Random walk of the axis in one hour (the report's unexplained drift).")
    ] = "0.4 um",
    noise: Annotated[str, Option(help="Noise of one cycle's mean.")] = "0.1 um",
    cycle: Annotated[str, Option(help="Length of one cycle.")] = "252 s",
    power: Annotated[
        float, Option(min=0.1, max=0.99, help="Wanted probability of detecting the weakest source.")
    ] = 0.8,
    largest: Annotated[
        list[str], Option(metavar="NAME=LEVEL", help="RESULTS: highest level of a driver, if not that of the record.")
    ] = [],  # noqa: B006
    nc: Annotated[
        Path | None, Option(help="RESULTS: write the schedule as an NC program of speeds and dwells.")
    ] = None,
    control: Annotated[str, Option(help="Control of --nc: linuxcnc, siemens840d or fanuc.")] = "linuxcnc",
    seed: Annotated[int, Option(min=0, help="Another seed is another, equally valid schedule.")] = 0,
    as_json: Annotated[bool, Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Propose a random duty schedule for a new test.

    It separates what is collinear when it is switched together: heat sources that are named, or what the results of a record left open,
    with the uncertainty of a prediction that is expected after it. A mat or a fan
    at a single place is a source, too: it tests the place itself.
    """
    from dataclasses import asdict

    from fusion.pipeline import plan as planned

    with _answering():
        if results is not None:
            tests = planned.next_tests(results, largest, seed=seed)
            if nc is not None:
                planned.write_nc_program(nc, planned.choose_test(tests), control=control)
            if as_json:
                print_json({"tried": [asdict(one) for one in tests], "proposed": asdict(planned.choose_test(tests))})
            else:
                _print_lines(planned.next_test_lines(tests))
            return
        duty = planned.propose_duty(
            source, effect=effect, drift=drift, noise=noise, cycle=cycle, power=power, seed=seed
        )
        if as_json:
            print_json({"hours": float(duty["test_hours"]), "switchings": planned.switchings(duty)})
        else:
            _print_lines(planned.duty_lines(duty, power=power))


def main() -> None:
    """Run the command line for `thermofuse.__main__`; the exit code is that of the process."""
    collect_garbage_less()
    # A service may start the command with its outputs closed: what is said goes nowhere then.
    sys.stdout, sys.stderr = (
        stream or os.fdopen(os.open(os.devnull, os.O_WRONLY), "w") for stream in (sys.stdout, sys.stderr)
    )
    # A terminal or pipe of another encoding than UTF-8 shows what it has no character for as its number.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    # xarray loads dask with its first array, a fifth of the time of a short command; frames on a cluster need it, and plug-ins may.
    needed = "xarray" in sys.modules or "--scheduler" in " ".join(sys.argv)
    if not needed and not _PLUGINS & metadata.entry_points().groups:
        sys.modules.setdefault("dask", None)  # type: ignore[arg-type]
    # What is wrong with a file is said once, in the words of the command.
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    try:
        app(prog_name="thermofuse")
    except SystemExit as ended:
        leave(ended.code if isinstance(ended.code, int) else ExitCode.DONE)
