"""Where datasets are, and how DSRL's are fetched: from a real server on this machine."""

import errno
import hashlib
import http.server
import os
import shutil
import subprocess
import threading

import pooch
import pytest
from five_episodes import SHORT_TASKS, make_arrays, refused

from tutorial_lib.data import sources
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.data.hdf5 import write_dataset
from tutorial_lib.tasks import TASKS

CAR_RUN = TASKS["CarRun"]


@pytest.fixture(autouse=True)
def short_tasks(monkeypatch):
    for name, task in SHORT_TASKS.items():
        monkeypatch.setitem(TASKS, name, task)


@pytest.fixture
def dataset():
    return Dataset(**make_arrays(), attributes={"seed": 3})


# --- Where datasets are ---


@pytest.fixture
def places(tmp_path, monkeypatch):
    """(the shipped data's folder, DSRL's folder), both empty."""
    shipped, dsrl = tmp_path / "data", tmp_path / "dsrl"
    shipped.mkdir(), dsrl.mkdir()
    monkeypatch.setattr(sources, "SHIPPED_DATA", shipped)
    monkeypatch.setenv("DSRL_DATASET_DIR", str(dsrl))
    return shipped, dsrl


def test_each_source_is_its_own_and_shipped_is_the_default(places, dataset, tmp_path):
    shipped, dsrl = places
    write_dataset(shipped / "CarRun.hdf5", dataset.select([0]), "CarRun")
    write_dataset(dsrl / "SafetyCarRun-v0-40-651.hdf5", dataset.select([0, 1]), "CarRun")
    elsewhere = write_dataset(tmp_path / "mine.hdf5", dataset.select([0, 1, 2]), "CarRun")
    folder = write_dataset(tmp_path / "more" / "CarRun.hdf5", dataset.select([0, 1, 2, 3]), "CarRun").parent
    load = lambda *source: sources.load_dataset("CarRun", *source).num_episodes  # noqa: E731
    assert [load(), load("shipped"), load("dsrl"), load(elsewhere), load(str(elsewhere))] == [1, 1, 2, 3, 3]
    assert [load(folder), load(str(folder))] == [4, 4]


def test_no_source_stands_in_for_another(places, dataset, tmp_path):
    shipped, dsrl = places
    write_dataset(dsrl / CAR_RUN.dsrl_file, dataset, "CarRun")
    write_dataset(shipped / "BallRun.hdf5", dataset, "BallRun")
    for task, source, looked in (
        ("CarRun", "shipped", shipped / "CarRun.hdf5"),
        ("BallRun", "dsrl", dsrl / TASKS["BallRun"].dsrl_file),
        ("CarRun", tmp_path / "absent.hdf5", tmp_path / "absent.hdf5"),
    ):
        with refused(f"^{looked}: .*c2iql fetch {task}`"):
            sources.find_dataset(task, source)


def test_dsrl_keeps_its_files_under_home_unless_told_otherwise(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("DSRL_DATASET_DIR", raising=False)
    assert sources.dsrl_directory() == tmp_path / ".dsrl" / "datasets"
    monkeypatch.setenv("DSRL_DATASET_DIR", "~/elsewhere")
    assert sources.dsrl_directory() == tmp_path / "elsewhere"


def test_the_shipped_data_lie_beside_the_package():
    assert sources.SHIPPED_DATA.parent.joinpath("tutorial_lib", "config.py").is_file()


@pytest.mark.parametrize("name", ["~nobody-of-this-name/x.hdf5", "a\0b.hdf5", "x" * 5000])
def test_an_impossible_path_is_no_file(name):
    with refused("no such file: check the path"):
        sources.load_dataset("CarRun", name)


# --- Checksums ---


def test_the_checksums_are_those_of_the_shipped_files():
    lines = (sources.SHIPPED_DATA / "checksums.txt").read_text().splitlines()
    files = sorted(sources.SHIPPED_DATA.glob("*.hdf5"))
    assert len(files) == 8
    assert lines == [f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}" for file in files]


def test_a_flipped_bit_of_a_shipped_file_is_noticed_wherever_it_is(places, dataset):
    shipped, _ = places
    path = write_dataset(shipped / "CarRun.hdf5", dataset, "CarRun")
    whole = path.read_bytes()
    sources.write_checksums()
    assert sources.load_dataset("CarRun").checksum == dataset.checksum
    for place in range(0, len(whole), 97):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with refused(f"^{path}: file: damaged: SHA-256 is .*: restore it from git"):
            sources.load_dataset("CarRun")
    path.write_bytes(whole)
    assert sources.load_dataset("CarRun", path).checksum == dataset.checksum


def test_a_replaced_file_needs_new_checksums(places, dataset):
    shipped, _ = places
    path = write_dataset(shipped / "CarRun.hdf5", dataset, "CarRun")
    sources.write_checksums()
    write_dataset(path, dataset.select([0]), "CarRun")
    with refused(r"sources.write_checksums\(\)"):
        sources.load_dataset("CarRun")
    assert sources.write_checksums() == shipped / "checksums.txt"
    assert sources.load_dataset("CarRun").num_episodes == 1


def test_only_shipped_files_are_verified_and_only_once(places, dataset, monkeypatch, tmp_path):
    shipped, dsrl = places
    write_dataset(shipped / "CarRun.hdf5", dataset, "CarRun")
    sources.write_checksums()
    for path in (dsrl / CAR_RUN.dsrl_file, shipped / "BallRun.hdf5"):  # the last has no line
        write_dataset(path, dataset, path.stem if path.stem in TASKS else "CarRun")
    hashed, sha256 = [], sources.sha256_of
    monkeypatch.setattr(sources, "sha256_of", lambda file: hashed.append(file) or sha256(file))
    for task, source in [("CarRun", "dsrl"), ("BallRun", "shipped"), *[("CarRun", "shipped")] * 2]:
        sources.load_dataset(task, source)
    assert hashed == [shipped / "CarRun.hdf5"]


# --- Fetching ---


class Server(http.server.ThreadingHTTPServer):
    """Serves `body` as CarRun's file; its first `breaks` answers stop half-way. Says no length if `mute`."""

    body, breaks, mute, requests = b"", 0, False, 0


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        server = self.server
        server.requests += 1
        if self.path != f"/files/{CAR_RUN.dsrl_file}":
            return self.send_error(404)
        broken = server.requests <= server.breaks
        self.send_response(200)
        if not server.mute:
            self.send_header("Content-Length", str(len(server.body)))
        self.end_headers()
        self.wfile.write(server.body[: len(server.body) // 2] if broken else server.body)

    def log_message(self, *args):
        pass


@pytest.fixture
def server(tmp_path_factory, dataset, monkeypatch):
    """A server on localhost, and its address in `.url`. Nobody waits before another try."""
    monkeypatch.setattr(pooch.core.time, "sleep", lambda seconds: None)
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.setenv(name, "127.0.0.1")
    file = write_dataset(tmp_path_factory.mktemp("served") / "served.hdf5", dataset, "CarRun")
    server = Server(("127.0.0.1", 0), Handler)
    server.body = file.read_bytes()
    server.url = f"http://127.0.0.1:{server.server_port}/files/"
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


def fetch(server, directory, task="CarRun"):
    return sources.fetch_dataset(task, directory, server.url)


@pytest.mark.parametrize("breaks", [0, 1, 2])
def test_fetch_survives_broken_connections(server, tmp_path, capsys, breaks):
    server.breaks = breaks
    path = fetch(server, tmp_path / "new")
    assert server.requests == breaks + 1
    assert path == tmp_path / "new" / CAR_RUN.dsrl_file and path.read_bytes() == server.body
    assert sorted(os.listdir(path.parent)) == [path.name, f"{path.name}.sha256"]
    shown = capsys.readouterr()
    assert f"{len(server.body):,} bytes, SHA-256 {hashlib.sha256(server.body).hexdigest()}" in shown.out
    assert "100%" in shown.err  # the progress bar


def test_fetch_goes_to_dsrls_folder_and_its_file_is_found(server, places, dataset):
    assert sources.fetch_dataset("CarRun", base_url=server.url).parent == places[1]
    assert sources.load_dataset("CarRun", "dsrl").num_episodes == dataset.num_episodes


@pytest.mark.skipif(not shutil.which("sha256sum"), reason="needs sha256sum")
def test_the_checksum_is_in_sha256sums_format(server, tmp_path):
    path = fetch(server, tmp_path)
    check = ["sha256sum", "--check", f"{path.name}.sha256"]
    assert subprocess.run(check, cwd=tmp_path, capture_output=True).returncode == 0
    with open(path, "ab") as file:
        file.write(b"!")
    assert subprocess.run(check, cwd=tmp_path, capture_output=True).returncode == 1


@pytest.mark.parametrize("mute", [False, True], ids=["length known", "length unknown"])
def test_fetch_gives_up_and_leaves_nothing(server, tmp_path, mute):
    server.breaks, server.mute = 99, mute
    with refused("not kept: .*file: truncated" if mute else f"^{server.url}.*: no connection, or it broke"):
        fetch(server, tmp_path)
    assert os.listdir(tmp_path) == []
    assert server.requests == (1 if mute else 3)


def test_a_second_fetch_verifies_and_downloads_nothing(server, tmp_path):
    path = fetch(server, tmp_path)
    assert fetch(server, tmp_path) == path and server.requests == 1
    with open(path, "ab") as file:
        file.write(b"!")
    digests = [hashlib.sha256(content).hexdigest() for content in (server.body + b"!", server.body)]
    with refused(f"^{path}: SHA-256 is {digests[0]}, but was {digests[1]} when first fetched"):
        fetch(server, tmp_path)
    assert path.read_bytes() == server.body + b"!"  # the user's file is the user's


def test_a_checksum_that_a_full_disk_cut_short_is_written_anew(server, tmp_path):
    path = fetch(server, tmp_path)
    memory = path.with_name(f"{path.name}.sha256")
    whole = memory.read_text()
    memory.write_text("")
    assert fetch(server, tmp_path) == path and server.requests == 1 and memory.read_text() == whole


def test_a_server_that_changed_its_file_is_noticed(server, tmp_path, dataset):
    path = fetch(server, tmp_path)
    path.unlink()
    other = write_dataset(tmp_path / "other.hdf5", dataset.select([0]), "CarRun")
    server.body = other.read_bytes()
    with refused(f"^{path}: what {server.url} sent is wrong, and not kept: .*SHA-256 is"):
        fetch(server, tmp_path)
    assert not path.exists()
    path.with_name(f"{path.name}.sha256").unlink()  # what the error says accepts it
    assert fetch(server, tmp_path).read_bytes() == server.body


def test_a_file_that_was_there_before_is_kept_and_remembered(server, tmp_path, dataset):
    path = write_dataset(tmp_path / CAR_RUN.dsrl_file, dataset.select([1, 2]), "CarRun")
    before = path.read_bytes()
    assert fetch(server, tmp_path) == path and server.requests == 0 and path.read_bytes() == before
    assert path.with_name(f"{path.name}.sha256").read_text().startswith(hashlib.sha256(before).hexdigest())


def test_a_page_instead_of_the_file_is_not_kept(server, tmp_path):
    server.body = b"<html>Please log in</html>"
    with refused("not an HDF5 file"):
        fetch(server, tmp_path)
    assert os.listdir(tmp_path) == []


def test_what_a_killed_fetch_left_is_dropped(server, tmp_path):
    leftover = tmp_path / f".{CAR_RUN.dsrl_file}.partial"
    leftover.mkdir()
    (leftover / CAR_RUN.dsrl_file).write_bytes(server.body[:-10])
    assert fetch(server, tmp_path).read_bytes() == server.body
    assert not leftover.exists()


def test_a_file_that_the_server_lacks(server, tmp_path):
    with refused(f"^{server.url}{TASKS['BallRun'].dsrl_file}: the server said 404 Not Found"):
        fetch(server, tmp_path, "BallRun")
    assert os.listdir(tmp_path) == []


def test_no_network(server, tmp_path):
    server.url = server.url.replace(str(server.server_port), "1")
    with refused(f"^{server.url}{CAR_RUN.dsrl_file}: no connection"):
        fetch(server, tmp_path)


@pytest.mark.parametrize(
    ("bound", "most", "words"),
    [("MAX_BYTES", 1_000, "more than 1,000 bytes"), ("MAX_SECONDS", -1, "not complete")],
)
def test_a_download_is_bounded_and_not_repeated(server, tmp_path, monkeypatch, bound, most, words):
    monkeypatch.setattr(sources, bound, most)
    with refused(f"^{server.url}{CAR_RUN.dsrl_file}: {words}"):
        fetch(server, tmp_path)
    assert server.requests == 1 and os.listdir(tmp_path) == []


def test_a_full_disk(server, tmp_path, monkeypatch):
    def write(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(pooch.HTTPDownloader, "__call__", write)
    with refused(f"^{tmp_path}: No space left on device: make room"):
        fetch(server, tmp_path)
    assert os.listdir(tmp_path) == []
