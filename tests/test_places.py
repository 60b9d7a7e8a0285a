"""Where the course's files are, and how they come from a release: from a real server on this machine."""

import hashlib
import http.server
import re
import threading
import time
import zipfile

import pytest

from tutorial_lib.data import places, release
from tutorial_lib.data.dataset import DatasetError

FILES = {
    "BallRun.hdf5": b"recorded " * 1000,
    "LICENSE": b"CC BY 4.0",
    "agents/BallRun.safetensors": b"",
    "results/table1.csv": b"task\nBallRun\n",
}


@pytest.fixture(autouse=True)
def installed(tmp_path, monkeypatch):
    """The package as if installed in `site`, with a home of its own. Returns `tmp_path`."""
    monkeypatch.setattr(places, "ROOT", tmp_path / "site")
    monkeypatch.delenv("C2IQL_DATA", raising=False)
    for name in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.setenv(name, "127.0.0.1")
    return tmp_path


def make_clone(root):
    (root / "data").mkdir(parents=True)
    (root / "environment.lock").touch()


def refused(pattern):
    """The error must be one line."""
    return pytest.raises(DatasetError, match=rf"\A(?!.*\n).*{pattern}")


# --- Where they are ---


def test_the_variable_goes_before_the_clone_and_the_clone_before_the_home(installed, monkeypatch):
    home = installed / "home" / ".c2iql"
    assert places.data_folder() == home
    (installed / "site" / "data").mkdir(parents=True)  # of another package
    assert places.data_folder() == home
    (installed / "site" / "data").rmdir()
    make_clone(installed / "site")
    assert places.data_folder() == installed / "site" / "data"
    for named, found in (("~/mine", installed / "home" / "mine"), (str(installed), installed)):
        monkeypatch.setenv("C2IQL_DATA", named)
        assert places.data_folder() == found
    monkeypatch.setenv("C2IQL_DATA", "")
    assert places.data_folder() == installed / "site" / "data"


def test_a_relative_variable_means_the_same_folder_after_a_change_of_folder(installed, monkeypatch):
    monkeypatch.chdir(installed)
    monkeypatch.setenv("C2IQL_DATA", "here")
    assert places.data_folder() == installed / "here"


def test_the_message_says_what_is_true_of_each_place(installed, monkeypatch):
    path = installed / "BallRun.hdf5"
    assert re.search(r"installed without its data: .*fetch --course.*C2IQL_DATA", places.why_missing(path))
    make_clone(installed / "site")
    assert places.why_missing(path) == f"{path}: not shipped with the project"
    monkeypatch.setenv("C2IQL_DATA", str(installed))
    assert "the folder that C2IQL_DATA names" in places.why_missing(path)


# --- Fetching a release ---


class Server(http.server.ThreadingHTTPServer):
    """Serves `body` in ten parts, each after `pause` seconds, and says that it has `length` bytes."""

    body, length, pause = b"", None, 0.0

    def handle_error(self, *args):
        """The client hangs up."""


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        server = self.server
        if self.path != "/0.2.0/c2iql-course.zip":
            return self.send_error(404)
        self.send_response(200)
        if server.length is not None:
            self.send_header("Content-Length", str(server.length))
        self.end_headers()
        size = len(server.body) // 10 + 1
        for start in range(0, len(server.body), size):
            time.sleep(server.pause)
            self.wfile.write(server.body[start : start + size])

    def log_message(self, *args):
        pass


@pytest.fixture
def server(installed):
    """A server on localhost with an archive of `FILES`, its address in `.url`, the SHA-256 in `.digest`."""
    data = installed / "packed"
    for name, content in FILES.items():
        (data / name).parent.mkdir(parents=True, exist_ok=True)
        (data / name).write_bytes(content)
    (data / ".BallRun.hdf5.tmp").touch()  # what a killed process left
    (data / "notes.py").touch()
    server = Server(("127.0.0.1", 0), Handler)
    serve(server, release.write_archive(data, installed).read_bytes())
    server.url = f"http://127.0.0.1:{server.server_port}/0.2.0/"
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


def serve(server, body):
    server.body, server.length, server.digest = body, len(body), hashlib.sha256(body).hexdigest()


def fetch(server, folder):
    return release.fetch_course(server.url, folder, server.digest)


def contents(folder):
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_equal_files_are_packed_into_equal_archives(server, installed, capsys):
    again = release.write_archive(installed / "packed", installed / "again")
    assert again.read_bytes() == server.body
    assert capsys.readouterr().out == f"{again}: {len(server.body):,} bytes, SHA-256 {server.digest}\n"


def test_fetch_brings_all_files_to_where_they_are_looked_up(server):
    server.length = None
    assert release.fetch_course(server.url, digest=server.digest) == places.data_folder()
    assert contents(places.data_folder()) == FILES


def test_a_second_fetch_writes_only_what_is_missing(server, installed, capsys):
    folder = fetch(server, installed / "course")
    (folder / "agents" / "BallRun.safetensors").unlink()
    (folder / "results" / "mine.csv").write_bytes(b"mine")
    before = (folder / "BallRun.hdf5").stat().st_mtime_ns
    fetch(server, folder)
    assert "files written: 1\n" in capsys.readouterr().out
    assert (folder / "BallRun.hdf5").stat().st_mtime_ns == before
    assert contents(folder) == FILES | {"results/mine.csv": b"mine"}


def test_a_file_of_the_user_is_not_replaced(server, installed):
    mine = installed / "course" / "results" / "table1.csv"
    mine.parent.mkdir(parents=True)
    mine.write_bytes(FILES["results/table1.csv"].upper())  # as long as the release's
    with refused(f"{re.escape(str(mine))}: differs"):
        fetch(server, installed / "course")
    assert list(contents(installed / "course")) == ["results/table1.csv"]


def test_what_is_not_this_versions_archive_is_not_kept(server, installed):
    archive = server.body
    server.body = archive[:-1] + b"!"
    with refused("SHA-256 is [0-9a-f]{64}, not"):
        fetch(server, installed / "course")
    serve(server, b"<html>Please log in</html>")
    with refused("not a zip file"):
        fetch(server, installed / "course")
    serve(server, archive.replace(b"recorded", b"Recorded", 1))
    with refused("damaged: Bad CRC-32"):
        fetch(server, installed / "course")
    assert contents(installed / "course") == {}


@pytest.mark.parametrize("name", ["../up.csv", "/root.csv", "C:/x.csv", "a\\b.csv", ".hidden.csv", "run.py"])
def test_an_archive_writes_nothing_but_the_courses_files_into_its_folder(server, installed, name):
    with zipfile.ZipFile(installed / "bad.zip", "w") as archive:
        archive.writestr("fine.csv", b"")
        archive.writestr(name, b"")
    serve(server, (installed / "bad.zip").read_bytes())
    with refused("no file of the course"):
        fetch(server, installed / "course")
    assert contents(installed / "course") == {}


@pytest.mark.parametrize("length", [None, 10**15], ids=["says nothing", "says too much"])
def test_a_download_is_bounded_in_bytes(server, installed, monkeypatch, length):
    monkeypatch.setattr(release, "MAX_BYTES", 1000)
    server.length = length
    with refused("more than 1,000 bytes"):
        fetch(server, installed / "course")
    assert contents(installed / "course") == {}


def test_an_archive_that_would_fill_the_disk_is_refused(server, installed, monkeypatch):
    with zipfile.ZipFile(installed / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros.csv", bytes(100_000))
    serve(server, (installed / "bomb.zip").read_bytes())
    monkeypatch.setattr(release, "MAX_BYTES", 99_999)
    with refused("unpacks to more than 99,999 bytes"):
        fetch(server, installed / "course")
    assert contents(installed / "course") == {}


@pytest.mark.parametrize(
    ("bound", "pause", "message"),
    [("MAX_SECONDS", 0.2, "not complete"), ("SILENCE", 0.6, "no connection")],
)
def test_a_download_is_bounded_in_time(server, installed, monkeypatch, bound, pause, message):
    """Also where the server is never silent for long: its ten parts take two seconds."""
    monkeypatch.setattr(release, bound, 0.3)
    server.pause, start = pause, time.monotonic()
    with refused(message):
        fetch(server, installed / "course")
    assert time.monotonic() - start < 1.5
    assert contents(installed / "course") == {}


def test_a_connection_that_breaks(server, installed):
    server.length += 1
    with refused("no connection, or it broke"):
        fetch(server, installed / "course")
    assert contents(installed / "course") == {}


def test_an_address_that_has_no_release(server, installed):
    server.url = server.url.replace("0.2.0", "9.9.9")
    with refused("the server said 404 Not Found"):
        fetch(server, installed / "course")
    with refused("no connection"):
        release.fetch_course("nowhere", installed / "course", server.digest)
    with refused("has no release to fetch from"):
        release.fetch_course("", installed / "course", server.digest)


def test_a_clone_fetches_nothing_over_its_own_files(installed, server):
    make_clone(installed / "site")
    with refused("this clone has"):
        release.fetch_course(server.url, digest=server.digest)


def test_a_folder_that_cannot_be_made(installed, server):
    (installed / "file").touch()
    with refused("make room there, or set C2IQL_DATA"):
        fetch(server, installed / "file" / "course")
