"""A server on this machine that gives wrong answers to `c2iql fetch`."""

import contextlib
import hashlib
import http.server
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

from hypothesis import strategies as st

from benchmarks.reliability.processes import Work, called
from tutorial_lib.data import release, sources

DIGEST = hashlib.sha256(b"the true archive").hexdigest()
LINKS = ("file:///etc/hostname", "ftp://127.0.0.1/x", "http://127.0.0.1:1/x", "//", "javascript:0")


class Handler(http.server.BaseHTTPRequestHandler):
    """Answers a request for /NUMBER/NAME with the file NUMBER, whose first line is the status and a link."""

    folder: Path

    def do_GET(self) -> None:
        first, _, body = (self.folder / self.path.split("/")[1]).read_bytes().partition(b"\n")
        status, _, link = first.decode().partition(" ")
        self.send_response(int(status))
        if link:
            self.send_header("Location", link)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@contextlib.contextmanager
def server(folder: Path, pause: float = 0.0) -> Iterator[str]:
    """Serves a folder's answers from a process of its own, and yields the address."""
    handler = type("Handler", (Handler,), {"folder": folder})
    listening = http.server.HTTPServer(("127.0.0.1", 0), handler)
    if not (child := os.fork()):
        with contextlib.suppress(BaseException):
            listening.serve_forever(0.05)
        os._exit(0)
    port = listening.server_port
    listening.server_close()  # the child has its own
    os.environ["NO_PROXY"] = os.environ["no_proxy"] = "127.0.0.1"
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def _fetch(address: str, course: bool) -> Work:
    """The command that fetches the course, or DSRL's file, from this address into the folder `fetched`."""
    if course:
        work = called(release.fetch_course, address, Path("fetched"), DIGEST)
    else:
        work = called(sources.fetch_dataset, "BallRun", Path("fetched"), f"{address}/")

    def at_once() -> None:
        time.sleep = lambda seconds: None  # in its own process: pooch waits before it tries again
        work()

    return at_once


@st.composite
def wrong(draw, address: str, folder: Path) -> tuple[str, Work]:
    """What is wrong with an answer, and the command that gets it."""
    course, number = draw(st.booleans()), len(os.listdir(folder))
    body = draw(st.binary(max_size=200) | st.sampled_from([b"PK\x03\x04", b"\x89HDF\r\n\x1a\n", b"<html>"]))
    link = draw(st.sampled_from(["", *LINKS]))
    status = draw(
        st.sampled_from([301, 302, 307]) if link else st.sampled_from([200, 200, 403, 404, 500, 503])
    )
    words = f"{'course' if course else 'DSRL'}: {status} {link} {body!r}"
    (folder / f"{number}").write_bytes(f"{status} {link}".strip().encode() + b"\n" + body)
    return words, _fetch(f"{address}/{number}", course)
