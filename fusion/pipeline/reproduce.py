"""Computes a finished run again from its provenance and tells what differs."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fusion.campaign.config import load_campaign
from fusion.campaign.remote import fetched_campaign, is_address
from fusion.common import versions
from fusion.pipeline.resume import hash_files, noted_campaign
from fusion.pipeline.run import run_campaign
from fusion.results.progress import Report, silent
from fusion.results.results import ResultsError, in_this_schema
from fusion.results.store import is_file_list, read_json

#: Differences that are listed one by one; the others are counted.
_MOST_LISTED = 12
#: Characters of a name or a value that are shown.
_LONGEST = 60


@dataclass(frozen=True)
class Reproduction:
    """Whether a second run of the same campaign gave the same ``results.json``, byte for byte, and what was compared or differs."""

    equal: bool
    lines: tuple[str, ...]


def reproduce(results: Path, *, campaign: Path | str | None = None, report: Report = silent) -> Reproduction:
    """Compute a run again and compare its ``results.json``, byte for byte."""
    provenance = _read_provenance(results)
    if is_address(campaign):
        with fetched_campaign(str(campaign), report=report) as mirror:
            return _compare(results, provenance, mirror.path, report)
    return _compare(results, provenance, Path(campaign or _campaign_of(results, provenance)), report)


def _compare(results: Path, provenance: Mapping[str, Any], path: Path, report: Report) -> Reproduction:
    """Compute a run again from a campaign file of this machine and compare it."""
    loaded = load_campaign(path)
    strange = _first(_compare_inputs(provenance["inputs"], hash_files(loaded.input_files(), report=report)))
    if strange:
        return Reproduction(False, (*strange, "the inputs are not those of the run, so it was not computed again"))
    before, now = provenance["versions"], versions()
    remarks = _first(
        f"{_cut(name)} {now.get(name, 'not used')}, was {_cut(str(before.get(name, 'not used')))}"
        for name in sorted({*before, *now})
        if before.get(name) != now.get(name)
    )
    first = (results / "results.json").read_bytes()
    # Before the long work: what is compared afterwards has to be JSON.
    written = in_this_schema(_read_json(results / "results.json"))
    with tempfile.TemporaryDirectory(prefix="thermofuse-") as folder:
        run_campaign(path, Path(folder) / "results", report=report)
        after = (Path(folder) / "results" / "results.json").read_bytes()
    differences = [] if first == after else list(_differences(written, json.loads(after), ""))
    if not differences:
        count = f"{len(provenance['inputs'])} input files"
        extent = f"all {len(first)} bytes" if first == after else "value for value"
        return Reproduction(True, (*remarks, f"equal: {count} give the same results.json, {extent}"))
    return Reproduction(
        False, (*remarks, f"different: {len(differences)} values of results.json", *_first(differences))
    )


def _first(lines: Iterable[str]) -> tuple[str, ...]:
    """Return the lines that are listed one by one, and how many more there are."""
    all_of_them = list(lines)
    rest = len(all_of_them) - _MOST_LISTED
    return (*all_of_them[:_MOST_LISTED], *((f"and {rest} more",) if rest > 0 else ()))


def _read_json(path: Path) -> Any:
    """Return what a file of a results folder holds."""
    try:
        return read_json(path)
    except ValueError as error:
        raise ResultsError(f"{path}: is not JSON ({error}); run the campaign again") from None


def _read_provenance(results: Path) -> dict[str, Any]:
    """Return the provenance of a finished run."""
    path = results / "provenance.json"
    if not path.is_file() or not (results / "results.json").is_file():
        raise ResultsError(f"{results}: holds no finished run; name a folder with results.json and provenance.json")
    content = _read_json(path)
    known = content if isinstance(content, dict) else {}
    if not is_file_list(known.get("inputs")) or not isinstance(known.get("versions"), dict):
        raise ResultsError(f"{path}: is not the provenance of a run; run the campaign again")
    return known


def _campaign_of(results: Path, provenance: Mapping[str, Any]) -> Path:
    """Return the campaign file where the run found it."""
    if (path := noted_campaign(results)) is not None:
        return path
    address = provenance.get("campaign_address")
    if isinstance(address, str):
        raise ResultsError(
            f"{results}: the campaign was read from {address}; name that with --campaign, and it is fetched again"
        )
    raise ResultsError(
        f"{results}: the campaign file is not where the run found it, seen from the results; name it with --campaign"
    )


def _compare_inputs(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for every input that is missing, new or changed."""
    # Earlier versions named a file outside the folder of the campaign without its folders.
    bare = {Path(name).name: name for name in now if name not in before}
    before = {bare.get(name, name) if name not in now else name: one for name, one in before.items()}
    for name in sorted({*before, *now}):
        if name not in now:
            yield f"{_cut(name)}: was an input of the run and is none now"
        elif name not in before:
            yield f"{name}: is an input now and was none of the run"
        elif before[name] != now[name]:
            yield f"{name}: its content has changed (SHA-256 {now[name]['sha256'][:12]}, was {str(before[name]['sha256'])[:12]})"


def _differences(before: Any, after: Any, place: str) -> Iterator[str]:
    """Yield a line for every value of two JSON documents that differs."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in dict.fromkeys([*before, *after]):
            yield from _differences(before.get(key), after.get(key), f"{place}.{_cut(key)}" if place else _cut(key))
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for number, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from _differences(one, other, f"{place}[{number}]")
    elif before != after:
        yield f"{place}: {_short(after)}, was {_short(before)}"


def _short(value: Any) -> str:
    try:
        return _cut(json.dumps(value, ensure_ascii=False))
    except RecursionError:
        return "brackets within brackets"


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
