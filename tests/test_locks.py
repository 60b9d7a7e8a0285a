"""One process at a time in a folder: the lock, who has it, what killed processes leave, and outputs.

Run as a script, this file is a process that trains in a folder.
"""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tiny import EVERY, make_agent, make_dataset

from tutorial_lib.checkpoints import save_agent
from tutorial_lib.files import HOLDER, check_output, held, written_whole
from tutorial_lib.training import train

ROOT = Path(__file__).parents[1]
OLD = time.time() - 2 * 3600
HOLD = """
import pathlib, sys
from tutorial_lib.files import held
try:
    with held(pathlib.Path(sys.argv[1])):
        print("held", flush=True)
        sys.stdin.read()
except OSError as error:
    print(f"{type(error).__name__}: {error}", flush=True)
"""
"""What a process does that holds a folder until its standard input ends."""


@pytest.fixture
def start():
    """Starts processes that run this file or `HOLD`, and waits for their first line."""
    children = []

    def started(*words):
        command, env = [sys.executable, *map(str, words)], os.environ | {"PYTHONPATH": str(ROOT)}
        child = subprocess.Popen(
            command, env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        children.append(child)
        return child, child.stdout.readline().strip()

    yield started
    for child in children:
        child.kill()
        child.communicate()


def files_in(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


# --- Two processes ---


def test_a_second_training_in_a_folder_is_one_line_at_once_and_the_first_loses_nothing(start, tmp_path):
    folder, alone = tmp_path / "run", tmp_path / "alone"
    child, said = start(__file__, folder, 1)
    assert said == "at a checkpoint", child.stderr.read()
    before = files_in(folder)
    with pytest.raises(BlockingIOError) as error:
        train(make_agent(seeds=(2,)), make_dataset(), run_dir=folder, **EVERY)  # the first one waits for us
    words = rf"{folder}: is in use by process {child.pid} on {socket.gethostname()} since 20\d\d-.*: wait "
    assert re.match(words, str(error.value)) and "\n" not in str(error.value)
    assert files_in(folder) == before

    out, errors = child.communicate("go on\n")
    assert child.returncode == 0 and out.strip() == "trained", errors
    agent = make_agent(seeds=(1,))
    train(agent, make_dataset(), run_dir=alone, **EVERY)
    save_agent(agent, alone / "agent.safetensors")
    assert files_in(folder).keys() == files_in(alone).keys()
    for name in ("agent.safetensors", "checkpoint.safetensors"):  # also: equal agents are equal files
        assert (folder / name).read_bytes() == (alone / name).read_bytes()


def test_the_lock_of_a_killed_process_is_taken_over(start, tmp_path):
    child, _ = start("-c", HOLD, tmp_path)
    assert json.loads((tmp_path / HOLDER).read_text())["pid"] == child.pid
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert (tmp_path / HOLDER).exists()
    with held(tmp_path):
        assert json.loads((tmp_path / HOLDER).read_text())["pid"] == os.getpid()
    assert files_in(tmp_path) == {}


def test_a_lock_of_another_machine_is_respected_until_it_is_deleted(tmp_path):
    holder = tmp_path / HOLDER
    holder.write_text(json.dumps({"host": "node\n7", "pid": 12, "since": "2026-01-02 03:04:05"}))
    with pytest.raises(BlockingIOError) as error, held(tmp_path):
        pytest.fail("it was taken")
    words = f"{tmp_path}: is in use by process 12 on node 7 since 2026-01-02 03:04:05: "
    assert str(error.value) == words + f"if that process runs no longer, delete {holder}"
    holder.unlink()
    with held(tmp_path):
        pass


@pytest.mark.parametrize("text", ["", "{", "[1]", '"x"', "[" * 100_000, "\0"])
def test_a_holder_that_cannot_be_read_is_nobody(text, tmp_path):
    (tmp_path / HOLDER).write_text(text)
    with held(tmp_path):
        assert json.loads((tmp_path / HOLDER).read_text())["host"] == socket.gethostname()


def test_a_process_may_lock_its_folder_again_and_frees_it_after_an_error(start, tmp_path):
    with pytest.raises(ZeroDivisionError), held(tmp_path), held(Path(os.path.relpath(tmp_path))):
        raise ZeroDivisionError
    with held(tmp_path):
        with held(tmp_path):
            pass
        child, said = start("-c", HOLD, tmp_path)
        assert said.startswith("BlockingIOError:")  # the inner block did not free it
    child, said = start("-c", HOLD, tmp_path)
    assert said == "held"


# --- What killed processes leave ---


def test_whoever_locks_a_folder_removes_what_killed_writers_left_and_nothing_else(tmp_path):
    number = "0123456789abcdef" * 2
    left = [f".checkpoint.safetensors.{number}.tmp", f".old.csv.{number}.tmp"]
    kept = [f".new.csv.{number}.tmp", ".notes.tmp", f"notes.{number}.tmp", f".x.{number}.tmp.txt", ".x.0.tmp"]
    for name in left + kept:
        (tmp_path / name).write_text("x")
    os.utime(tmp_path / left[1], (OLD, OLD))
    with held(tmp_path):
        assert sorted(files_in(tmp_path).keys() - {HOLDER, ".lock"}) == sorted(kept)


def test_a_temporary_file_has_a_name_that_is_removed(tmp_path):
    with pytest.raises(FileNotFoundError), written_whole(tmp_path / "a.safetensors") as temporary:
        temporary.write_text("half")
        with held(tmp_path):
            assert not temporary.exists()


# --- Outputs ---


def test_an_output_that_can_be_written_leaves_nothing(tmp_path):
    (tmp_path / "old.csv").write_text("old")
    for path in (tmp_path / "new.csv", tmp_path / "old.csv", tmp_path / "deep" / "deeper" / "new.csv"):
        check_output(path)
    assert files_in(tmp_path) == {"old.csv": b"old"} and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("name", ["folder", "file/x.csv", "file/deep/x.csv", "link/x.csv", "n" * 300])
def test_an_output_that_cannot_be_written_is_one_line(name, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(OSError) as error:
        check_output(tmp_path / name)
    assert "\n" not in str(error.value) and str(tmp_path) in str(error.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder", "link"]


def test_an_output_in_a_folder_without_permission_is_one_line(tmp_path, monkeypatch):
    def refuses(self, **options):  # as for a user who may not write; the tests may run as root, who may
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "touch", refuses)
    with pytest.raises(OSError) as error:
        check_output(tmp_path / "results.csv")
    words = f"nothing can be written to {tmp_path}: choose another path: {tmp_path}: Permission denied"
    assert str(error.value) == words


def test_a_folder_that_is_a_file_is_refused_before_anything_is_learned(tmp_path, monkeypatch):
    agent, path = make_agent("C2IQL"), tmp_path / "run"
    path.write_text("mine")
    monkeypatch.setattr(agent, "prepare", lambda *args: pytest.fail("learned"))
    with pytest.raises(OSError, match=f"nothing can be written to {path}: .* is not a folder"):
        train(agent, make_dataset(), run_dir=path, **EVERY)
    assert path.read_text() == "mine"


# --- The other process ---


def train_and_wait(folder, seed):
    """Trains in a folder, and waits at the second checkpoint for a line."""
    agent = make_agent(seeds=(seed,))

    def wait(agent):
        if agent.updates == 40:
            print("at a checkpoint", flush=True)
            sys.stdin.readline()

    with held(folder):
        train(agent, make_dataset(), run_dir=folder, on_checkpoint=wait, **EVERY)
        save_agent(agent, folder / "agent.safetensors")
    print("trained", flush=True)


if __name__ == "__main__":
    train_and_wait(Path(sys.argv[1]), int(sys.argv[2]))
