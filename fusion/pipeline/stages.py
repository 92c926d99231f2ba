"""The stages of a run: what each depends on, where its product is, and whether it must be computed or is kept."""

from __future__ import annotations

import ctypes
import logging
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic

from fusion.beside import Beside, InTurn
from fusion.campaign.config import Campaign
from fusion.pipeline.provenance import FileState, dependencies, versions
from fusion.products.progress import Report
from fusion.products.results import Notice, Outcome
from fusion.products.store import Product, StageStamps, annotate, digest, write_dataset

if TYPE_CHECKING:
    from fusion.report.charts.campaign import Drawn

_log = logging.getLogger(__name__)

#: Where each stage keeps its Dataset; what ends up in fusion.nc is kept apart while it may have to be resumed.
FILES = {
    "fields": "fields.nc",
    "deviations": "deviations.nc",
    "correlation": ".stages/correlation.nc",
    "model": ".stages/model.nc",
    "record": "fusion.nc",
}
#: What each stage is called in progress and provenance.
LABELS = {
    "fields": "thermal fields",
    "deviations": "deviations",
    "correlation": "correlation",
    "model": "anomalies and closed loop",
    "record": "closed loop on the record",
}


@dataclass(frozen=True)
class Stage(Generic[Product]):
    """A stage of a run.

    Attributes
    ----------
    name : str
        Name of the stage.
    tables : tuple of str
        Tables of the campaign file that its result depends on, with the files that they name.
    after : tuple of str
        Stages that its result depends on; it is computed again whenever one of them is.
    compute : callable
        ``compute(report=report)`` computes the stage.
    read : callable
        Reads the product that a kept stage has written.
    """

    name: str
    tables: tuple[str, ...]
    after: tuple[str, ...]
    compute: Callable[..., Outcome[Product]]
    read: Callable[[Path], Product]


def _timed(compute: Callable[..., Outcome[Product]], *, report: Report) -> tuple[Outcome[Product], float]:
    """Compute a stage; return the wall time that it took too, s."""
    begun = time.monotonic()
    return compute(report=report), time.monotonic() - begun


def _timed_and_drawn(
    compute: Callable[..., Outcome[Product]], draw: Callable[[Outcome[Product]], Drawn], *, report: Report
) -> tuple[tuple[Outcome[Product], float], Drawn | None]:
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
    campaign : Campaign
        The checked campaign file.
    folder : Path
        Results folder.
    report : callable
        ``report(label, done, total)``, for progress.
    stamps : StageStamps
        Stages that are done.
    inputs : mapping
        Size and SHA-256 of each input.
    seen : mapping
        Size and time of change of each input before it was read.
    started : datetime
        Start of the run, UTC.
    address : str or None
        Where the campaign file was fetched from.
    beside : Beside
        Takes stages that the next one does not wait for.
    depends : tuple
        What every stage depends on beside campaign and files, as it was at the start.
    drawn : list of callable
        Each waits for a part of the charts and returns it.
    parts, notices : dict, list
        Parts of results.json and notices of the stages so far.
    seconds, keys : dict
        Wall time (s) and input digest by stage.
    products : list of Path
        What the run wrote or kept.
    """

    campaign: Campaign
    folder: Path
    report: Report
    stamps: StageStamps
    inputs: Mapping[str, Mapping[str, Any]]
    seen: Mapping[str, FileState]
    started: datetime
    address: str | None = None
    beside: Beside = field(default_factory=InTurn)
    depends: tuple[Any, ...] = field(default_factory=dependencies)
    drawn: list[Callable[[], Drawn]] = field(default_factory=list)
    parts: dict[str, Any] = field(default_factory=dict)
    notices: list[Notice] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    keys: dict[str, str] = field(default_factory=dict)
    products: list[Path] = field(default_factory=list)

    def stage(self, stage: Stage[Product]) -> Product:
        """Return the product of a stage: computed and stamped, or kept where its input has not changed.

        Parameters
        ----------
        stage : Stage
            What is to be done.
        """
        return self._finish(stage, partial(_timed, stage.compute, report=self.report))

    def begin(
        self, stage: Stage[Product], draw: Callable[[Outcome[Product]], Drawn] | None = None
    ) -> Callable[[], Product]:
        """Begin a stage beside what follows, where it is not kept; return what waits for it and gives its product, as `stage` does.

        Parameters
        ----------
        stage : Stage
            Its work can be pickled.
        draw : callable, optional
            Draws what the stage found, for `drawn`; it can be pickled too.
        """
        if self.stamps.done(stage.name, self.key_of(stage)):
            if draw is not None:
                self.draw(partial(draw, self._kept(stage)))
            return partial(self.stage, stage)
        if draw is None:
            return partial(self._finish, stage, self.beside.start(partial(_timed, stage.compute), self.report))
        both = cache(self.beside.start(partial(_timed_and_drawn, stage.compute, draw), self.report))

        def drawn() -> Drawn:
            (outcome, _), charts = both()
            return draw(outcome) if charts is None else charts

        self.drawn.append(drawn)
        return partial(self._finish, stage, lambda: both()[0])

    def draw(self, work: Callable[[], Drawn]) -> None:
        """Begin to draw a part of the charts.

        Parameters
        ----------
        work : callable
            It can be pickled.
        """
        self.drawn.append(self.beside.start(work))

    def _kept(self, stage: Stage[Product]) -> Outcome[Product]:
        """Return what is kept of a stage."""
        note = self.stamps.note(stage.name)
        notices = tuple(Notice(**item) for item in note["notices"])
        return Outcome(stage.read(self.folder / FILES[stage.name]), note["parts"], notices)

    def _finish(self, stage: Stage[Product], compute: Callable[[], tuple[Outcome[Product], float]]) -> Product:
        """Write and stamp what a stage computes in so many seconds, or read what is kept of it."""
        name, key = stage.name, self.key_of(stage)
        path = self.folder / FILES[name]
        kept = self.stamps.done(name, key)
        _return_freed_memory()
        computed, spent_s = (None, 0.0) if kept else compute()
        begun = time.monotonic()
        if computed is None:
            outcome = self._kept(stage)
            self.report(f"{LABELS[name]} (kept)", 1, 1)
        else:
            outcome = replace(computed, dataset=self.described(computed.dataset))
            write_dataset(path, outcome.dataset)
            self.stamps.record(
                name, key, [path], {"parts": outcome.parts, "notices": [vars(item) for item in outcome.notices]}
            )
            del computed
        _return_freed_memory()
        self.keys[name] = key
        self.products.append(path)
        self.parts.update(outcome.parts)
        self.notices.extend(outcome.notices)
        self.seconds[name] = spent_s + time.monotonic() - begun
        return outcome.dataset

    def key_of(self, stage: Stage[Any]) -> str:
        """Return a digest of everything that the result of a stage depends on."""
        asked = self.campaign.model_dump(mode="json", include=set(stage.tables))
        files = {file: self.inputs[file] for table in stage.tables for file in self.campaign.files_of(table)}
        zone = self.campaign.campaign.time_zone
        return digest(stage.name, *self.depends, zone, asked, files, [self.keys[earlier] for earlier in stage.after])

    def checkpoint(self, key: str) -> Path:
        """Return the folder that keeps the finished cycles of a long recording; folders of other inputs are removed."""
        chosen = self.folder / ".stages" / f"cycles_{key[:16]}"
        for stale in chosen.parent.glob("cycles_*"):
            if stale != chosen:
                shutil.rmtree(stale)
        return chosen

    def described(self, product: Product) -> Product:
        """Return a product with title, history and provenance."""
        history = f"{self.started.isoformat(timespec='seconds')} thermofuse run {self.campaign.path.name}"
        origin = {"software": "thermofuse", "versions": versions(), "inputs": dict(self.inputs)}
        return annotate(product, title=self.campaign.campaign.title, history=history, provenance=origin)
