"""Campaigns on ``s3://`` or ``https://``: the files that a campaign names are fetched into a folder of this machine and checked there.

Nothing is fetched unless the user names an address. A file is fetched again only when its size or its stamp (ETag, or time of change)
differs from what was fetched before.
"""

from __future__ import annotations

import csv
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urljoin, urlsplit

import filelock

from fusion.campaign.values import FILE_KEYS
from fusion.common import FusionError, place_within
from fusion.common.toml_files import TomlError, read_toml
from fusion.results.progress import Report, silent
from fusion.results.store import file_sha256, read_json_object, write_json
from interferometry.common import InterferometryError
from thermofuse.resources import resource
from thermography.common import ThermographyError
from thermography.io.files import write_atomically

#: Names a folder that keeps what is fetched; left out, that of the user's cache.
CACHE_VARIABLE = "THERMOFUSE_CACHE"
_STAMPS = ".origin.json"
#: A file whose connection is lost is asked for so many times, with a pause that doubles, s.
_TRIALS, _PAUSE_S = 4, 0.5
#: Files that are fetched at a time: many small ones wait for the answer, not for the line.
_AT_A_TIME = 8
#: Bytes of a file whose server does not state its length, at most: more than a recording of a day.
_MOST_UNSTATED = 20_000_000_000
_GLOB = re.compile(r"[*?\[]")


class RemoteError(FusionError):
    """A remote campaign that cannot be fetched; the message names the address and the remedy."""


class _NotThereError(RemoteError):
    """A file, folder or bucket that is not there."""


def is_address(place: object) -> bool:
    """Return whether something that a user has named is an address and not a path."""
    return isinstance(place, str) and re.match(r"[A-Za-z][A-Za-z0-9+.-]+://", place) is not None


def cache_folder() -> Path:
    """Return the folder that keeps what is fetched: that of THERMOFUSE_CACHE, or one in the user's cache."""
    if named := os.environ.get(CACHE_VARIABLE):
        return Path(named)
    import pooch

    return Path(pooch.os_cache("thermofuse")) / "remote"


def require_outside_cache(folder: Path) -> None:
    """Refuse results among what is fetched, where they would be mixed with files that are replaced and removed."""
    if folder.resolve().is_relative_to(cache_folder().resolve()):
        raise RemoteError(f"{folder} is in {cache_folder()}, the download cache; name another folder with --out")


@dataclass(frozen=True)
class Mirror:
    """Files of an address in a folder of this machine.

    Attributes
    ----------
    address : what the user named
    path : the file that it names, here
    base, folder : address of its folder, and that folder here
    files, fetched, fetched_bytes : files, those of them that had to be fetched now, and their size
    """

    address: str
    path: Path
    base: str
    folder: Path
    files: int
    fetched: int
    fetched_bytes: int

    def with_address(self, text: str) -> str:
        """Return a text with the address in place of the folder."""
        return text.replace(f"{self.folder.resolve()}{os.sep}", f"{self.base}/").replace(str(self.folder), self.base)

    def line(self) -> str:
        """Return what was fetched, as a sentence."""
        size = f"{self.fetched_bytes / 1e6:.1f} MB"
        return f"{self.address}: {self.files} files, {self.fetched} of them fetched now ({size}) into {self.folder}"


def fetch_file(address: str, *, report: Report = silent) -> Mirror:
    """Fetch one file."""
    return _fetch(address, lambda path: [], report)


def fetch_campaign(address: str, *, report: Report = silent) -> Mirror:
    """Fetch a campaign file and every file that it names."""
    return _fetch(address, partial(_file_names, address=address), report)


def _fetch(address: str, names_in: Callable[[Path], list[str]], report: Report) -> Mirror:
    """Fetch a file and those that it names; remove those that it named before and names no more: a pattern would match them."""
    base, _, name = _checked(address).rpartition("/")
    store = _Store(base, name)
    path = store.folder / name
    with store.open() as stamps:
        sizes = store.fetch({name: store.stamp(name)}, stamps, report)
        names = names_in(path)
        for one in names:
            if is_address(one) or place_within(store.folder, one) is None:
                raise RemoteError(f'{address}: "{one}" is outside the folder of the campaign file; put the file there')
        found = store.find(names)
        sizes += store.fetch(found, stamps, report)
        for stale in stamps.keys() - found.keys() - {name}:
            (store.folder / stale).unlink(missing_ok=True)
            del stamps[stale]
    return Mirror(address, path, base, store.folder, 1 + len(found.keys() - {name}), len(sizes), sum(sizes))


@contextmanager
def fetched_campaign(address: str, *, report: Report = silent) -> Iterator[Mirror]:
    """Fetch a campaign; faults within that name its files name their addresses instead."""
    mirror = fetch_campaign(address, report=report)
    try:
        yield mirror
    except (FusionError, ThermographyError, InterferometryError) as error:
        text = mirror.with_address(str(error))
        if text == str(error):
            raise
        raise type(error)(text) from error


def _checked(address: str) -> str:
    """Return an address that can be fetched; refuse others."""
    parts = urlsplit(address)
    if parts.scheme not in ("s3", "http", "https"):
        raise RemoteError(
            f"{parts.scheme}://...: campaigns are read from s3://, https:// and http://, or from a folder"
        )
    if "@" in parts.netloc or parts.query or parts.fragment:
        raise RemoteError(
            f"{parts.scheme}://{parts.hostname}{parts.path}: an address with a password, a query or a # is not read, because results name "
            "their address; keep keys where the system does (the environment, ~/.aws)"
        )
    if not parts.netloc or not parts.path.strip("/") or parts.path.endswith("/"):
        raise RemoteError(
            f"{address}: names a folder; name the file in it, for example {address.rstrip('/')}/campaign.toml"
        )
    return address


def _file_names(campaign: Path, address: str) -> list[str]:
    """Return the names and patterns of files in a campaign file."""
    try:
        content, _ = read_toml(campaign)
    except (TomlError, UnicodeDecodeError) as error:
        raise RemoteError(f"{address}: this is not TOML: {error}; see the campaign file in the README") from None
    names: list[str] = []
    for table, keys in FILE_KEYS.items():
        for key in keys:
            value: Any = content.get(table)
            for part in key.split("."):
                value = value.get(part) if isinstance(value, dict) else None
            names += [value] if isinstance(value, str) else [one for one in value or () if isinstance(one, str)]
    return names


class _Store:
    """A folder at an address, and the folder of this machine that mirrors it for the one file that was named."""

    def __init__(self, base: str, name: str) -> None:
        self.base = base
        self.folder = cache_folder() / sha256(f"{base}/{name}".encode()).hexdigest()[:16]
        self.system = _file_system(base)

    @contextmanager
    def open(self) -> Iterator[dict[str, Any]]:
        """Hold the folder; yield stamps of the files in it by name, and store them at the end."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / _STAMPS
        with filelock.FileLock(self.folder / ".lock"):
            noted = read_json_object(path).get("files")
            stamps = noted if isinstance(noted, dict) else {}
            for name in stamps:
                if place_within(self.folder, name) is None:
                    raise RemoteError(f"{path}: {name!r} leads out of {self.folder}; remove this folder of the cache")
            try:
                yield stamps
            finally:
                write_json(path, {"address": self.base, "files": stamps})

    def find(self, names: Iterable[str]) -> dict[str, Any]:
        """Return the files that names and patterns name, with their stamps; one that is not there is left to the check of the campaign."""
        found: dict[str, None] = {}
        for name in names:
            if _GLOB.search(name):
                matches = self._ask(partial(self.system.glob, self._address(name, keep="*?[]")), name)
                found |= dict.fromkeys(sorted(map(self._name, matches)))
            else:
                found[name] = None

        def stamp(name: str) -> dict[str, Any] | None:
            try:
                return self.stamp(name)
            except _NotThereError:
                return None

        with ThreadPoolExecutor(_AT_A_TIME) as executor:
            there = dict(zip(found, executor.map(stamp, found), strict=True))
        return {name: known for name, known in there.items() if known is not None}

    def fetch(self, there: Mapping[str, Any], stamps: dict[str, Any], report: Report) -> list[int]:
        """Fetch the files that are not here as they are there; return their sizes."""
        new = [name for name in there if stamps.get(name) != there[name] or not self._is_here(name, there[name])]
        total, sizes = sum(there[name]["bytes"] or 0 for name in new), []
        self._require_room(total)
        label = f"fetching {total / 1e6:.1f} MB"
        if new:
            report(label, 0, total)
        with ThreadPoolExecutor(_AT_A_TIME) as executor:
            for name, size in zip(new, executor.map(lambda name: self._fetch_one(name, there[name]), new), strict=True):
                stamps[name] = there[name]
                sizes.append(size)
                report(label, sum(sizes), max(total, sum(sizes)))
        return sizes

    def _address(self, name: str, keep: str = "") -> str:
        """Return the address of a file."""
        return f"{self.base}/{quote(name, safe='/' + keep) if self.base.startswith('http') else name}"

    def _name(self, address: str) -> str:
        """Return the name of a file that was listed; refuse one outside the folder."""
        web = self.base.startswith("http")
        base = self.base if web else self.base.split("://", 1)[1]
        name = unquote(address.removeprefix(f"{base}/")) if web else address.removeprefix(f"{base}/")
        if not address.startswith(f"{base}/") or place_within(self.folder, name) is None:
            raise RemoteError(f"{self.base}: lists {address}, which is outside it; name the files one by one")
        return name

    def stamp(self, name: str) -> dict[str, Any]:
        """Return size and stamp of a file there."""
        info = self._ask(partial(self.system.info, self._address(name)), name)
        stamp = next((str(info[key]) for key in ("ETag", "LastModified", "Last-Modified") if info.get(key)), "")
        return {"bytes": info.get("size"), "stamp": stamp}

    def _is_here(self, name: str, stamp: Mapping[str, Any]) -> bool:
        path = self.folder / name
        return bool(stamp["stamp"]) and path.is_file() and path.stat().st_size == stamp["bytes"]

    def _require_room(self, total: int) -> None:
        free = shutil.disk_usage(self.folder).free
        if total > 0.95 * free:
            raise RemoteError(
                f"{self.base}: {total / 1e9:.1f} GB are to be fetched and {self.folder} has {free / 1e9:.1f} GB left; name a larger "
                f"disk in {CACHE_VARIABLE}"
            )

    def _fetch_one(self, name: str, stamp: Mapping[str, Any]) -> int:
        """Fetch a file whole or not at all; return its size."""
        wanted = stamp["bytes"]

        def watch(size: int | None, done: int, **_: Any) -> None:
            if done > (_MOST_UNSTATED if wanted is None else wanted):
                raise RemoteError(
                    f"{self._address(name)}: goes on after {done} bytes, more than the server states or a recording has; fetch it by hand"
                )

        def fetch(temporary: Path) -> None:
            from fsspec.callbacks import Callback  # of the extra remote

            self.system.get_file(self._address(name), str(temporary), callback=Callback(hooks={"length": watch}))
            size = temporary.stat().st_size
            if wanted is not None and size != wanted:
                raise ConnectionError(f"ended after {size} of {wanted} bytes")

        path = self._ask(partial(write_atomically, self.folder / name, fetch), name)
        return int(path.stat().st_size)

    def _ask(self, ask: Callable[[], Any], name: str) -> Any:
        """Return an answer of the server; ask again where the connection is lost, and name what is not there or may not be read."""
        address = self._address(name)
        for trial in range(1, _TRIALS + 1):
            try:
                return ask()
            except Exception as error:
                fault = _root(error)
                if isinstance(fault, RemoteError):
                    raise fault from None
                if isinstance(fault, FileNotFoundError) or getattr(fault, "status", None) == 404:
                    raise _NotThereError(f"{address}: there is no such file or bucket; check the address") from error
                reason = _describe(fault)
                if reason is not None:
                    raise RemoteError(f"{address}: {reason}") from error
                if not _is_connection(fault):
                    raise
                if trial == _TRIALS:
                    raise RemoteError(
                        f"{address}: the connection was lost {_TRIALS} times ({type(fault).__name__}: {fault}); what was fetched is "
                        "kept: start the same command again"
                    ) from error
                time.sleep(_PAUSE_S * 2 ** (trial - 1))
        raise AssertionError("the last trial returns or raises")


def _root(error: BaseException) -> BaseException:
    """Return the fault of a server or connection behind what a library raised: fsspec says that a file is missing whatever it met."""
    fault = error
    while fault.__cause__ is not None and not isinstance(fault, PermissionError):
        fault = fault.__cause__
    # The S3 client has words of its own for what it has understood already.
    return error if type(fault).__module__.startswith("botocore") and isinstance(error, OSError) else fault


def _describe(fault: BaseException) -> str | None:
    """Return why a server does not give a file, with the remedy; None where asking again may help."""
    status = getattr(fault, "status", None)
    if isinstance(fault, PermissionError) or status in (401, 403):
        return "may not be read with the keys that are set; ask for permission, or set others (for S3: AWS_PROFILE or AWS_ACCESS_KEY_ID)"
    if type(fault).__name__ in ("NoCredentialsError", "PartialCredentialsError"):
        return "no keys for S3 are set; set AWS_PROFILE, or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
    if type(fault).__name__ == "ClientResponseError" and 400 <= (status or 0) < 500 and status not in (408, 429):
        return f"the server refuses it (status {status})"
    return None


def _is_connection(fault: BaseException) -> bool:
    """Return whether a fault is one of the connection, of whichever library."""
    modules = type(fault).__module__.split(".")[0]
    return isinstance(fault, OSError | TimeoutError) or modules in ("aiohttp", "botocore", "aiobotocore", "fsspec")


def _file_system(base: str) -> Any:
    """Return the file system of an address."""
    try:
        import fsspec

        if base.startswith("s3:"):
            return fsspec.filesystem("s3", skip_instance_cache=True, use_listings_cache=False)
        import aiohttp

        # A file of hours of video takes as long as it takes; only silence ends it.
        limits = aiohttp.ClientTimeout(total=None, sock_connect=20, sock_read=60)
        watched = aiohttp.TraceConfig()
        watched.on_request_redirect.append(_stay_on_the_server)
        options = {"timeout": limits, "trace_configs": [watched]}
        return fsspec.filesystem(
            "http", skip_instance_cache=True, use_listings_cache=False, client_kwargs=options, encoded=True
        )
    except ImportError as error:
        raise RemoteError(
            f"{base}: the package {error.name} is not installed: install it beside thermofuse (pip install {error.name})"
        ) from error


async def _stay_on_the_server(session: Any, context: Any, answer: Any) -> None:
    """Refuse to be sent from the server that the user named to another one, or from https to http."""
    target = urlsplit(urljoin(str(answer.url), answer.response.headers.get("Location", "")))
    named = urlsplit(str(answer.url))
    if target.hostname != named.hostname or (named.scheme == "https" and target.scheme != "https"):
        raise RemoteError(
            f"{answer.url}: the server sends to {target.scheme}://{target.netloc}, which is not the one that was named; name the address "
            "there if you trust it"
        )


# Public measured files: what `data/registry.csv` lists, fetched once and held to their SHA-256.

REGISTRY = resource("registry.csv")
#: Names a folder that holds the files under their registry names; then nothing is downloaded.
FOLDER_VARIABLE = "THERMOFUSE_DATA"


class DatasetError(FusionError):
    """A measured file that is not listed, not there, or not what the registry promises."""


@dataclass(frozen=True)
class Dataset:
    """A public measured file: where it is published, its SHA-256, its size in bytes, its licence and what it holds."""

    name: str
    address: str
    sha256: str
    size: int
    licence: str
    what: str


def read_registry(path: Path = REGISTRY) -> dict[str, Dataset]:
    """Return the listed files by name."""
    if not path.exists():
        raise DatasetError(f"{path}: no registry of measured files; install thermofuse again")
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        row["name"]: Dataset(row["name"], row["address"], row["sha256"], int(row["bytes"]), row["licence"], row["what"])
        for row in rows
    }


def fetch_sample(name: str, *, registry: str | Path = REGISTRY) -> Path:
    """Return the local path of a public measured file, downloading it once where no local folder is named.

    Parameters
    ----------
    name : str
        Name of the file in the registry, such as ``"gtatters__Thermimage/inst/extdata/IR_2412.jpg"``.
    registry : str or Path
        CSV table of the files with address, SHA-256, size and licence; the one of the package by default.

    Returns
    -------
    Path
        The file, held to its SHA-256.

    Raises
    ------
    DatasetError
        The file is not listed, cannot be had, or is not what the registry promises.

    Notes
    -----
    Files are kept in the user's cache; ``THERMOFUSE_DATA`` names a folder that holds them under their names in the registry instead, and
    then nothing is downloaded.

    Examples
    --------
    >>> from fusion import fetch_sample
    >>> fetch_sample("anderssandstrom__ecmc_target_muts_logger/b02/x/target_x.md_ISO230.dat")  # doctest: +SKIP
    """
    listed = read_registry(Path(registry))
    if name not in listed:
        raise DatasetError(
            f"{name!r} is not listed in {registry}; the first of {len(listed)} names is {next(iter(listed))!r}"
        )
    dataset = listed[name]
    if not (folder := os.environ.get(FOLDER_VARIABLE)):
        import pooch

        target = pooch.os_cache("thermofuse") / name
        try:
            return Path(
                pooch.retrieve(dataset.address, f"sha256:{dataset.sha256}", fname=target.name, path=target.parent)
            )
        except (OSError, ValueError) as error:
            raise DatasetError(
                f"{name}: could not be fetched from {dataset.address} ({error}); "
                f"copy the file by hand and name its folder in {FOLDER_VARIABLE}"
            ) from error
    path = Path(folder) / name
    if not path.exists():
        raise DatasetError(
            f"{path} does not exist; {FOLDER_VARIABLE} must name a folder with the files under registry names"
        )
    digest = file_sha256(path)
    if digest != dataset.sha256:
        raise DatasetError(f"{path}: SHA-256 is {digest}, the registry promises {dataset.sha256}; fetch the file again")
    return path
