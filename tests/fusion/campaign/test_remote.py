"""Campaigns of a plain web server and of an S3 server of this machine: fetched once, kept, and refused with the address and the remedy."""

import asyncio
import json
import os
import re
import shutil
import socket
import threading
from contextlib import nullcontext
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar, get_args

import pytest
from typer.testing import CliRunner

from fusion import cli
from fusion.campaign import remote
from fusion.campaign.config import Campaign, load_campaign
from fusion.campaign.remote import RemoteError, fetch_campaign, fetch_file, is_address
from fusion.campaign.values import FILE_KEYS
from fusion.pipeline.reproduce import reproduce
from fusion.pipeline.run import run_campaign
from tests.fusion.campaign_parts import change, keep_cycles, without

pytest.importorskip("aiohttp", reason="needs the extra remote")

# Both clients leave their sockets to the garbage collector.
pytestmark = [
    pytest.mark.long,
    pytest.mark.filterwarnings(
        "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::DeprecationWarning"
    ),
]


class Shelf(SimpleHTTPRequestHandler):
    """Lists folders and gives files; what it gave is noted, and it breaks off in the middle of some of them."""

    given: ClassVar[list[str]] = []
    breaks: ClassVar[dict[str, int]] = {}
    sends: ClassVar[dict[str, str]] = {}

    def log_message(self, *arguments):
        pass

    def do_GET(self):
        Shelf.given.append(self.path)
        if self.path in Shelf.sends:
            self.send_response(302)
            self.send_header("Location", Shelf.sends[self.path])
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        name = self.path.rsplit("/", 1)[-1]
        if Shelf.breaks.get(name, 0) > 0:
            Shelf.breaks[name] -= 1
            content = Path(self.translate_path(self.path)).read_bytes()
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content[: len(content) // 2])
            self.wfile.flush()
            self.connection.shutdown(socket.SHUT_RDWR)
            return
        super().do_GET()

    def send_head(self):
        if "forbidden" in self.path:
            self.send_error(403)
            return None
        return super().send_head()


@pytest.fixture(scope="module")
def shelf(campaign_folder, tmp_path_factory):
    """Address of a folder with a campaign of the laser alone, its readings, two frames, and much that it does not name."""
    folder = tmp_path_factory.mktemp("shelf")
    day = shutil.copytree(campaign_folder, folder / "day 1", ignore=shutil.ignore_patterns("thermal"))
    part = without(day / "campaign.toml", "thermography", "plan", "plan.axis", "model", name="laser.toml")
    part.write_text(part.read_text() + "\n[model]\ndeclared = []\n")
    keep_cycles(day / "laser.csv", *range(1, 6))
    (day / "thermal").mkdir()
    for frame in sorted((campaign_folder / "thermal").iterdir())[:2]:
        shutil.copy(frame, day / "thermal" / f"no {frame.name}")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Shelf, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", day
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv(remote.CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(remote, "_PAUSE_S", 0.01)
    Shelf.given, Shelf.breaks, Shelf.sends = [], {}, {}
    return tmp_path / "cache"


def test_every_key_of_a_campaign_that_names_files_is_known():
    """A file key that is added to a table must be listed, or neither provenance nor remote campaigns know the file."""
    for name, field in Campaign.model_fields.items():
        for table in (one for one in get_args(field.annotation) if hasattr(one, "model_fields")):
            types = {key: f"{one.annotation}{one.metadata}" for key, one in table.model_fields.items()}
            checked = [key for key, told in types.items() if re.search("_existing|_matching", told)]
            assert checked == [key for key in FILE_KEYS.get(name, ()) if "." not in key]


def test_addresses_are_told_from_paths():
    assert is_address("s3://bucket/campaign.toml") and is_address("https://host/a/campaign.toml")
    assert not is_address("C:/a/campaign.toml") and not is_address(Path("s3://a")) and not is_address("a/b.toml")


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("ftp://host/a/campaign.toml", r"ftp://...: campaigns are read from s3://, https:// and http://"),
        ("https://jane:secret@host/a/campaign.toml", r"https://host/a/campaign.toml: an address with a password"),
        ("https://host/a/campaign.toml?key=1", r"https://host/a/campaign.toml: an address with a password, a query"),
        ("s3://bucket", r"names a folder; name the file in it, for example s3://bucket/campaign.toml"),
        ("s3://bucket/day/", r"for example s3://bucket/day/campaign.toml"),
    ],
)
def test_addresses_that_are_not_read_are_refused(address, message):
    with pytest.raises(RemoteError, match=message) as refused:
        fetch_campaign(address)
    assert "secret" not in str(refused.value)


def test_what_a_campaign_names_is_fetched_and_nothing_else(shelf, cache):
    server, day = shelf
    mirror = fetch_campaign(f"{server}/day%201/campaign.toml")
    here = {path.relative_to(mirror.folder).as_posix() for path in mirror.folder.rglob("*") if path.is_file()}
    frames = {f"thermal/{path.name}" for path in (day / "thermal").iterdir()}
    assert len(frames) == 2
    named = {"campaign.toml", "fiducials.csv", "laser.csv", "environment.csv", "drivers.csv", *frames}
    assert here - {".lock", ".origin.json"} == named
    assert (mirror.folder / "laser.csv").read_bytes() == (day / "laser.csv").read_bytes()
    assert (mirror.files, mirror.fetched) == (7, 7)
    assert set(load_campaign(mirror.path).input_files()) == named
    # Nothing has changed there, so nothing is fetched again; then one file changes, and one is gone.
    Shelf.given.clear()
    assert fetch_campaign(f"{server}/day%201/campaign.toml").fetched == 0
    assert not [path for path in Shelf.given if not path.endswith("/")]
    os.utime(day / "laser.csv", (1e9, 1e9))
    gone = min((day / "thermal").iterdir())
    content = gone.read_bytes()
    gone.unlink()
    again = fetch_campaign(f"{server}/day%201/campaign.toml")
    gone.write_bytes(content)
    assert again.fetched == 1
    assert not (again.folder / "thermal" / gone.name).exists()


def test_a_run_check_and_reproduction_name_the_address(shelf, cache, tmp_path):
    server, _ = shelf
    address = f"{server}/day%201/laser.toml"
    checked = CliRunner().invoke(cli.app, ["check", address])
    assert checked.exit_code == 0, checked.output
    out = tmp_path / "results"
    steps = []
    run_campaign(address, out, report=lambda label, done, total: steps.append(label))
    assert steps.count("reading and checking") == 2
    provenance = json.loads((out / "provenance.json").read_text())
    assert provenance["campaign_address"] == address
    assert provenance["campaign_file"] is None
    assert len(provenance["inputs"]["laser.csv"]["sha256"]) == 64
    for product in ("provenance.json", "results.json", "report.html"):
        assert str(cache) not in (out / product).read_text()
    with pytest.raises(remote.FusionError, match=rf"was read from {address}; name that with --campaign"):
        reproduce(out)
    assert reproduce(out, campaign=address).equal


def test_a_fault_of_a_remote_file_names_its_address(shelf, cache, tmp_path):
    server, day = shelf
    change(without(day / "laser.toml", name="broken.toml"), '"laser.csv"', '"absent.csv"')
    ended = CliRunner().invoke(cli.app, ["run", f"{server}/day%201/broken.toml", "--out", str(tmp_path / "r")])
    assert ended.exit_code == 2
    assert f"{server}/day%201/broken.toml, line" in ended.output
    assert str(cache) not in ended.output


def test_inspect_takes_the_address_of_a_file(shelf):
    server, _ = shelf
    ended = CliRunner().invoke(cli.app, ["inspect", f"{server}/day%201/laser.csv"])
    assert ended.exit_code == 0, ended.output
    assert f"{server}/day%201/laser.csv" in ended.output


def test_a_connection_that_breaks_is_tried_again_and_then_named(shelf, cache):
    server, day = shelf
    Shelf.breaks = {"laser.csv": 2}
    mirror = fetch_file(f"{server}/day%201/laser.csv")
    assert mirror.path.read_bytes() == (day / "laser.csv").read_bytes()
    assert Shelf.given.count("/day%201/laser.csv") == 3
    Shelf.breaks = {"environment.csv": 99}
    with pytest.raises(RemoteError, match=r"(?s)environment.csv: the connection was lost 4 times .* fetched is kept"):
        fetch_file(f"{server}/day%201/environment.csv")
    assert not [path for path in mirror.folder.iterdir() if path.name.startswith("environment")]


def test_what_is_not_there_or_may_not_be_read_is_named(shelf, cache):
    server, day = shelf
    with pytest.raises(RemoteError, match=r"/day%201/nothing.toml: there is no such file or bucket; check the address"):
        fetch_campaign(f"{server}/day%201/nothing.toml")
    with pytest.raises(RemoteError, match=r"forbidden.csv: may not be read with the keys that are set"):
        fetch_file(f"{server}/forbidden.csv")
    with pytest.raises(RemoteError, match=r"http://127.0.0.1:9/a.toml: the connection was lost 4 times"):
        fetch_file("http://127.0.0.1:9/a.toml")
    (day / "outside.toml").write_text('[plan]\nfiducials = "../../secret.csv"\n')
    with pytest.raises(RemoteError, match=r'outside.toml: "../../secret.csv" is outside the folder of the campaign'):
        fetch_campaign(f"{server}/day%201/outside.toml")
    # What was noted of an earlier download removes nothing outside it.
    mirror, secret = fetch_file(f"{server}/day%201/campaign.toml"), cache / "secret.csv"
    secret.write_text("precious")
    (mirror.folder / ".origin.json").write_text(json.dumps({"files": {"../secret.csv": {}}}))
    with pytest.raises(RemoteError, match=r"\.origin\.json: '\.\./secret\.csv' leads out"):
        fetch_file(f"{server}/day%201/campaign.toml")
    assert secret.read_text() == "precious"


def test_a_server_is_followed_on_itself_only(shelf):
    address, _ = shelf
    Shelf.sends = {
        "/here.csv": "/day%201/laser.csv",
        "/away.csv": f"{address.replace('127.0.0.1', 'localhost')}/day%201/laser.csv",
    }
    assert fetch_file(f"{address}/here.csv").path.read_text().startswith("cycle")
    with pytest.raises(RemoteError, match=r"away\.csv: the server sends to http://localhost:\d+, which is not the one"):
        fetch_file(f"{address}/away.csv")


@pytest.mark.parametrize(
    ("named", "location", "refused"),
    [
        ("https://a.org/x", "https://a.org/y", False),
        ("https://a.org/x", "y", False),
        ("http://a.org/x", "https://a.org/x", False),
        ("https://a.org/x", "http://a.org/x", True),
        ("https://a.org/x", "//b.org/x", True),
        ("https://a.org/x", "file:///etc/passwd", True),
    ],
)
def test_where_a_server_may_send(named, location, refused):
    answer = SimpleNamespace(url=named, response=SimpleNamespace(headers={"Location": location}))
    with pytest.raises(RemoteError, match="sends to") if refused else nullcontext():
        asyncio.run(remote._stay_on_the_server(None, None, answer))


def test_two_campaigns_of_one_folder_keep_their_files(shelf):
    address, day = shelf
    shutil.copy(day / "laser.csv", day / "other.csv")
    change(without(day / "laser.toml", name="second.toml"), "laser.csv", "other.csv")
    first = fetch_campaign(f"{address}/day%201/laser.toml")
    second = fetch_campaign(f"{address}/day%201/second.toml")
    assert (first.folder / "laser.csv").is_file() and (second.folder / "other.csv").is_file()
    assert fetch_campaign(f"{address}/day%201/laser.toml").fetched == 0


def test_results_are_not_written_into_the_cache(shelf, cache):
    address, _ = shelf
    with pytest.raises(RemoteError, match=r"is in .*cache, the download cache; name another folder with --out"):
        run_campaign(f"{address}/day%201/laser.toml", cache / "a" / "results")
    assert not cache.exists()


def test_a_disk_that_is_too_small_is_refused_before_anything_is_fetched(shelf, monkeypatch):
    server, _ = shelf
    monkeypatch.setattr(shutil, "disk_usage", lambda path: os.terminal_size((0, 0)) and type("U", (), {"free": 10})())
    with pytest.raises(RemoteError, match=r"GB are to be fetched and .* has 0.0 GB left; .* in THERMOFUSE_CACHE"):
        fetch_file(f"{server}/day%201/laser.csv")


def test_a_file_of_no_stated_length_has_a_ceiling(shelf, monkeypatch):
    server, _ = shelf
    monkeypatch.setattr(remote, "_MOST_UNSTATED", 100)
    monkeypatch.setattr(remote._Store, "stamp", lambda self, name: {"bytes": None, "stamp": ""})
    with pytest.raises(RemoteError, match=r"laser\.csv: goes on after \d+ bytes, .* fetch it by hand"):
        fetch_file(f"{server}/day%201/laser.csv")


@pytest.fixture
def bucket(campaign_folder, monkeypatch):
    """An S3 server of this machine with a campaign in a bucket; its address is in the environment, as users set it."""
    pytest.importorskip("s3fs", reason="needs the extra remote")
    server_module = pytest.importorskip("moto.server", reason="needs moto")
    import boto3

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    server = server_module.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    client = boto3.client("s3")
    client.create_bucket(Bucket="axes")
    for name in ("campaign.toml", "fiducials.csv", "laser.csv", "environment.csv", "drivers.csv"):
        client.upload_file(str(campaign_folder / name), "axes", f"day/{name}")
    for frame in sorted((campaign_folder / "thermal").iterdir())[:2]:
        client.upload_file(str(frame), "axes", f"day/thermal/{frame.name}")
    yield "s3://axes/day/campaign.toml"
    server.stop()


def test_a_campaign_in_a_bucket_is_fetched_once(bucket, campaign_folder):
    mirror = fetch_campaign(bucket)
    assert (mirror.files, mirror.fetched) == (7, 7)
    assert (mirror.folder / "laser.csv").read_bytes() == (campaign_folder / "laser.csv").read_bytes()
    assert len(load_campaign(mirror.path).frame_paths()) == 2
    assert fetch_campaign(bucket).fetched == 0
    with pytest.raises(RemoteError, match=r"s3://nowhere/campaign.toml: there is no such file or bucket"):
        fetch_campaign("s3://nowhere/campaign.toml")


def test_no_network_is_asked_for_a_path(campaign_folder, monkeypatch):
    monkeypatch.setattr(remote, "_file_system", None)
    assert CliRunner().invoke(cli.app, ["check", str(campaign_folder / "campaign.toml"), "--quiet"]).exit_code == 0
