"""What of an earlier run is kept: on what each stage depends, where its product is, and whether it must be computed again."""

from __future__ import annotations

import ctypes
import json
import logging
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fusion.analysis.effects.library import GROUP, describe_code, plugins
from fusion.campaign.config import Campaign
from fusion.common import place_within, versions
from fusion.pipeline.workers import Worker
from fusion.results import store
from fusion.results.progress import Report, silent
from fusion.results.results import Notice, Outcome, Parts, Results, read_results
from thermography.io.other_cameras import ENTRY_POINT_GROUP

if TYPE_CHECKING:
    from fusion.report.charts.embedded import Drawn


# Provenance of a run: versions, inputs with their SHA-256, parameters, times, and the command; and whether a run is
# there already.

#: Number of the products' layout: stages that were kept in another one are computed again.
PRODUCT_LAYOUT = 8
#: The stamp of a whole run, which its last stage gets.
_REPORT = "report"


def hash_files(files: Mapping[str, Path], *, report: Report = silent) -> dict[str, dict[str, Any]]:
    """Return size and SHA-256 of each file."""
    hashed = {}
    for done, (name, path) in enumerate(files.items()):
        report("input files", done, len(files))
        hashed[name] = {"bytes": path.stat().st_size, "sha256": store.file_sha256(path)}
    report("input files", len(files), len(files))
    return hashed


def dependencies() -> tuple[int, dict[str, str], list[dict[str, Any]]]:
    """Return what every product depends on besides campaign and files: its layout, the versions, and the plug-ins with their code."""
    groups = [*([GROUP] if plugins() else []), ENTRY_POINT_GROUP]
    added = [plugin for group in groups for plugin in describe_code(group)]
    for plugin in added:
        plugin["code"] = [store.file_sha256(path) for path in plugin["code"]]
    return PRODUCT_LAYOUT, versions(), added


def stamp_run(
    stamps: store.StageStamps, campaign: Campaign, inputs: Mapping[str, Mapping[str, Any]], products: Sequence[Path]
) -> None:
    """Stamp that a run is whole, so that `kept_results` knows it again."""
    stamps.record(_REPORT, _run_key(campaign), products, {"inputs": inputs})


def kept_results(campaign: Campaign, folder: Path) -> Results | None:
    """Return the results of a whole run of the same campaign from the same input, or None where anything has to be done."""
    stamps = store.StageStamps(folder)
    if not stamps.done(_REPORT, _run_key(campaign)):
        return None
    noted, files = stamps.note(_REPORT)["inputs"], campaign.input_files()
    sizes = {name: path.stat().st_size for name, path in files.items() if path.is_file()}
    if sizes != {name: known["bytes"] for name, known in noted.items()} or hash_files(files) != noted:
        return None
    return read_results(folder)


def forget_run(stamps: store.StageStamps) -> None:
    """Take the stamp of a whole run away, before its products are written again."""
    stamps.forget(_REPORT)


def _run_key(campaign: Campaign) -> str:
    return store.digest(_REPORT, dependencies(), campaign.model_dump(mode="json", exclude={"path"}))


@dataclass(frozen=True)
class FileState:
    """What tells without reading a file whether it was changed: its size, bytes, and the time of its last change, ns."""

    size: int
    changed_ns: int


def input_states(campaign: Campaign) -> dict[str, FileState]:
    """Return size and time of change of every input that there is, keyed by its name relative to the campaign file."""
    states = {}
    for name, path in campaign.input_files().items():
        try:
            found = path.stat()
        except FileNotFoundError:
            continue
        states[name] = FileState(found.st_size, found.st_mtime_ns)
    return states


def note_changes(before: Mapping[str, FileState], after: Mapping[str, FileState]) -> Iterator[Notice]:
    """Return a notice of the inputs that were added, removed or changed while a run read them, or none."""
    parts = {
        "changed": [name for name in before if name in after and before[name] != after[name]],
        "removed": [name for name in before if name not in after],
        "added": [name for name in after if name not in before],
    }
    words = [
        f"{len(names)} {what} ({', '.join(names[:3])}{', ...' if len(names) > 3 else ''})"
        for what, names in parts.items()
        if names
    ]
    if words:
        altered = "; ".join(words)
        yield Notice.of("inputs_changed", altered=altered)


def refuse_other_campaign(folder: Path, campaign: Campaign, inputs: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse a results folder that holds the results of another campaign: a run that goes on there would replace them.

    One of the same recordings, by a campaign file that is still there, replaces them with a warning: so one changed file after the other
    is tried on what is kept.
    """
    known = store.read_json_object(folder / "provenance.json")
    here, there = _place_from(folder, campaign.path), known.get("campaign_file")
    if not store.is_file_list(known.get("inputs")) or not isinstance(there, str) or here in (None, there):
        return
    tables = ("thermography", "interferometry", "record")
    recordings = {inputs[name]["sha256"] for table in tables for name in campaign.files_of(table) if name in inputs}
    stated = known.get("parameters")
    about = stated.get("campaign") if isinstance(stated, dict) else None
    named = f'"{about.get("title")}", {there}' if isinstance(about, dict) else there
    if recordings & {one["sha256"] for one in known["inputs"].values()}:
        if noted_campaign(folder) is not None:
            _log.warning("%s held the results of %s, which those of %s replace", folder, named, campaign.path)
        return
    raise store.OutputError(
        f"{folder} holds the results of another campaign ({named}), which --resume would replace by those of "
        f'{campaign.path} ("{campaign.campaign.title}"); name another folder with --out, or remove this one first'
    )


def describe_run(
    campaign: Campaign,
    inputs: Mapping[str, Mapping[str, Any]],
    folder: Path,
    *,
    started: datetime,
    seconds: Mapping[str, float],
    products: Iterable[Path] = (),
    address: str | None = None,
) -> dict[str, Any]:
    """Return the provenance of a run, without names of machine or user."""
    named = {path.relative_to(folder).as_posix(): path for path in products}
    return {
        "software": "thermofuse",
        "versions": versions(),
        "command": [Path(sys.argv[0]).stem, *(_without_folder(argument) for argument in sys.argv[1:])],
        "campaign_file": _place_from(folder, campaign.path) if address is None else None,
        **({} if address is None else {"campaign_address": address}),
        "started": started.isoformat(timespec="seconds"),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "stage_seconds": {name: round(value, 2) for name, value in seconds.items()},
        "parameters": campaign.model_dump(mode="json", exclude={"path"}, exclude_none=True),
        "inputs": dict(inputs),
        "readings": [*campaign.files_of("interferometry"), *campaign.files_of("record")],
        "products": hash_files(named),
    }


def _place_from(folder: Path, campaign: Path) -> str | None:
    """Return the campaign file as seen from the results folder, or None where the way would name folders of the user."""
    try:
        way = Path(os.path.relpath(campaign, folder.resolve()))
    except ValueError:  # another drive
        return None
    return way.as_posix() if way.parts.count("..") <= 1 and len(way.parts) <= 3 else None


def noted_campaign(folder: Path) -> Path | None:
    """Return the campaign file where the run of a results folder found it; None where it is not noted, or no longer there."""
    place, folder = store.read_json_object(folder / "provenance.json").get("campaign_file"), folder.resolve()
    path = place_within(folder.parent, f"{folder.name}/{place}") if isinstance(place, str) else None
    # A name that is too long for a file is an error of the system.
    with suppress(OSError):
        return path.resolve() if path is not None and path.is_file() else None
    return None


def _without_folder(argument: str) -> str:
    """Return a command-line argument without the folders of an absolute path, which belong to one machine only."""
    return Path(argument).name if Path(argument).is_absolute() else argument


_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Stage:
    """A stage of a run whose product is kept.

    Attributes
    ----------
    label : what it is called in progress
    file : its product; what ends up in fusion.nc is kept apart while it may have to be resumed
    tables : tuple of str
        Tables of the campaign file that its result depends on, with the files that they name; see `Run.taken` for parts of another one.
    after : stages that its result depends on where the run made them before; it is computed again whenever one of them is
    read : reads the product
    """

    label: str
    file: str
    tables: tuple[str, ...]
    after: tuple[str, ...]
    read: Callable[[Path], Any]


#: Tables whose files may give times without their zone.
_ZONED = {"interferometry", "sensors", "drivers", "record"}
_CORRELATED = ("plan", "interferometry", "drivers")
_MODELLED = ("plan", "interferometry", "sensors", "drivers", "model")
STAGES = {
    "thermograms": Stage("thermograms", "thermograms.nc", ("thermography", "plan"), (), store.read_dataset),
    "fields": Stage("thermal fields", "fields.nc", ("thermography", "plan"), (), store.open_dataset),
    "deviations": Stage("deviations", "deviations.nc", ("interferometry",), ("fields",), store.read_grouped),
    "correlation": Stage(
        "correlation", ".stages/correlation.nc", _CORRELATED, ("fields", "deviations"), store.read_tree
    ),
    "model": Stage(
        "anomalies and closed loop", ".stages/model.nc", _MODELLED, ("fields", "deviations"), store.read_dataset
    ),
    "record": Stage("closed loop on the record", "fusion.nc", ("record", "model"), (), store.read_dataset),
}


def _timed(compute: Callable[..., Outcome[store.Product]], *, report: Report) -> tuple[Outcome[store.Product], float]:
    """Compute a stage; return the wall time that it took too, s."""
    begun = time.monotonic()
    return compute(report=report), time.monotonic() - begun


def _timed_and_drawn(
    compute: Callable[..., Outcome[store.Product]], draw: Callable[[Outcome[store.Product]], Drawn], *, report: Report
) -> tuple[tuple[Outcome[store.Product], float], Drawn | None]:
    """Compute a stage, and draw what it found where that is at hand; see `_timed`. A chart that cannot be drawn costs no result."""
    outcome, spent_s = _timed(compute, report=report)
    try:
        return (outcome, spent_s), draw(outcome)
    except Exception as error:
        _log.warning("what the stage found could not be drawn (%r); it is tried again for the report", error)
        return (outcome, spent_s), None


def _return_freed_memory() -> None:
    """Give the memory that was left back to the system, where the C library keeps it for what follows (glibc does)."""
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


@dataclass
class Run:
    """One run of a campaign into one folder.

    Attributes
    ----------
    inputs : size and SHA-256 of each input
    seen : size and time of change of each input before it was read
    started : start of the run, UTC
    address : where the campaign file was fetched from
    worker : takes stages that the next one does not wait for
    depends : what every stage depends on besides campaign and files, as it was at the start
    drawn : each waits for a part of the charts and returns it
    taken : by stage, what its own product alone depends on of tables that it does not list whole
    parts, notices : parts of results.json and notices of the stages so far
    seconds, keys : wall time (s), and digest of the input by stage, without what it takes for its own product alone
    products : what the run wrote or kept
    """

    campaign: Campaign
    folder: Path
    report: Report
    stamps: store.StageStamps
    inputs: Mapping[str, Mapping[str, Any]]
    seen: Mapping[str, FileState]
    started: datetime
    address: str | None = None
    worker: Worker = field(default_factory=Worker)
    depends: tuple[Any, ...] = field(default_factory=dependencies)
    drawn: list[Callable[[], Drawn]] = field(default_factory=list)
    taken: dict[str, Any] = field(default_factory=dict)
    parts: Parts = field(default_factory=Parts)
    notices: list[Notice] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    keys: dict[str, str] = field(default_factory=dict)
    products: list[Path] = field(default_factory=list)

    def stage(self, name: str, compute: Callable[..., Outcome[Any]]) -> Any:
        """Return the product of a stage: computed and stamped, or kept where its input has not changed."""
        return self._finish(name, self._key(name), partial(_timed, compute, report=self.report))

    def begin(
        self, name: str, compute: Callable[..., Outcome[Any]], draw: Callable[[Outcome[Any]], Drawn] | None = None
    ) -> Callable[[], Any]:
        """Begin a stage in the second process, where it is not kept; return what waits for it and gives its product, as `stage` does."""
        key = self._key(name)
        if self.stamps.done(name, key):
            if draw is not None:
                self.draw(partial(draw, self._kept(name)))
            return partial(self._finish, name, key, None)
        if draw is None:
            return partial(self._finish, name, key, self.worker.submit(partial(_timed, compute), self.report))
        both = cache(self.worker.submit(partial(_timed_and_drawn, compute, draw), self.report))

        def drawn() -> Drawn:
            (outcome, _), charts = both()
            return draw(outcome) if charts is None else charts

        self.drawn.append(drawn)
        return partial(self._finish, name, key, lambda: both()[0])

    def draw(self, work: Callable[[], Drawn]) -> None:
        """Begin to draw a part of the charts."""
        self.drawn.append(self.worker.submit(work))

    def _kept(self, name: str) -> Outcome[Any]:
        """Return what is kept of a stage, under the title and the inputs of this run."""
        note, path = self.stamps.note(name), self.folder / STAGES[name].file
        notices = tuple(Notice(**item) for item in note["notices"])
        if store.retitle(path, self._described):
            self.stamps.renew(path)
        return Outcome(STAGES[name].read(path), Parts.model_validate(note["parts"]), notices)

    def _finish(self, name: str, key: str, compute: Callable[[], tuple[Outcome[Any], float]] | None) -> Any:
        """Write and stamp what a stage computes in so many seconds, or read what is kept of it."""
        path = self.folder / STAGES[name].file
        _return_freed_memory()
        if compute is None or self.stamps.done(name, key):
            spent_s, begun = 0.0, time.monotonic()
            outcome = self._kept(name)
            self.report(f"{STAGES[name].label} (kept)", 1, 1)
        else:
            computed, spent_s = compute()
            begun = time.monotonic()
            outcome = replace(computed, dataset=self.described(computed.dataset))
            store.write_dataset(path, store.in_groups(outcome.dataset) if name == "deviations" else outcome.dataset)
            found = {"parts": outcome.parts, "notices": [vars(item) for item in outcome.notices]}
            self.stamps.record(name, key, [path], found)
            del computed
        _return_freed_memory()
        self.keys[name] = self._shared_key(name)
        self.products.append(path)
        self.parts.take(outcome.parts)
        self.notices.extend(outcome.notices)
        self.seconds[name] = spent_s + time.monotonic() - begun
        return outcome.dataset

    def _key(self, name: str) -> str:
        """Return a digest of everything that the product of a stage depends on."""
        return store.digest(self._shared_key(name), self.taken.get(name))

    def _shared_key(self, name: str) -> str:
        """Return a digest of what the result of a stage depends on as far as later stages use it."""
        stage = STAGES[name]
        settings = self.campaign.model_dump(mode="json", include=set(stage.tables))
        files = {file: self.inputs[file] for table in stage.tables for file in self.campaign.files_of(table)}
        zone = self.campaign.campaign.time_zone if _ZONED & {*stage.tables} else None
        earlier = [self.keys[one] for one in stage.after if one in self.keys]
        return store.digest(name, *self.depends, zone, settings, files, earlier)

    def checkpoint(self, name: str) -> Path:
        """Return the folder that keeps the finished cycles of a long recording; folders of other inputs are removed."""
        chosen = self.folder / ".stages" / f"cycles_{self._key(name)[:16]}"
        for stale in chosen.parent.glob("cycles_*"):
            if stale != chosen:
                shutil.rmtree(stale)
        return chosen

    def described(self, product: store.Product) -> store.Product:
        """Return a product with title, history and provenance."""
        history = f"{self.started.isoformat(timespec='seconds')} thermofuse run {self.campaign.path.name}"
        return store.annotate(product, history=history, **self._described)

    @property
    def _described(self) -> dict[str, str]:
        """Title and provenance of this run, as every product carries them."""
        origin = {"software": "thermofuse", "versions": versions(), "inputs": dict(self.inputs)}
        return {"title": self.campaign.campaign.title, "provenance": json.dumps(origin, sort_keys=True)}
