"""Packs the course's datasets, agents and results into one archive, and downloads it from a release.

The archive is a zip file without compression, as the files in it are compressed. Equal files give an equal
archive. Its SHA-256 is a constant of this module, so that a package accepts only the files of its release.
"""

import hashlib
import os
import shutil
import tempfile
import time
import zipfile
import zlib
from pathlib import Path
from typing import IO

from tutorial_lib.data.dataset import DatasetError
from tutorial_lib.data.places import VARIABLE, data_folder, in_clone
from tutorial_lib.files import sha256_of, written_whole

RELEASE_URL = ""
"""The address of the folder that has this version's archive. It is empty until there is a release."""
RELEASE_SHA256 = ""
"""The SHA-256 of this version's archive, which `make release` prints."""
ARCHIVE = "c2iql-course.zip"
KINDS = (".hdf5", ".safetensors", ".csv", ".png", ".md", ".txt")
"""The suffixes of the files in an archive. Nothing in them is run. LICENSE has no suffix."""
MAX_BYTES = 500_000_000
"""An archive, or its unpacked files, may have this number of bytes."""
MAX_SECONDS = 3600
"""A download may take this number of seconds, and the server be silent for `SILENCE`."""
SILENCE = 30


def write_archive(data: Path | str, folder: Path | str) -> Path:
    """Writes the course's files in `data` to the archive in `folder`. Prints its size and SHA-256."""
    data, path = Path(data), Path(folder) / ARCHIVE
    files = sorted(file.relative_to(data).as_posix() for file in data.rglob("*") if file.is_file())
    with written_whole(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name in files:
            if _is_ours(name):  # an entry has no time, so that equal files give an equal archive
                archive.writestr(zipfile.ZipInfo(name), (data / name).read_bytes())
    print(f"{path}: {path.stat().st_size:,} bytes, SHA-256 {sha256_of(path)}")
    return path


def fetch_course(
    base_url: str = RELEASE_URL, folder: Path | None = None, digest: str = RELEASE_SHA256
) -> Path:
    """Downloads a release's archive, unpacks it into `folder` and returns the folder.

    The default of `folder` is `data_folder()`. `digest` is the SHA-256 that the archive must have, so any
    server can be trusted to have it. Files that are in the folder with the same content are left, so a fetch
    that was killed can be repeated. No file is replaced by another: where one differs, nothing is written.

    Raises DatasetError where there is no release, no network, no such file on the server or no space, for an
    archive that is too large, takes too long, is damaged or another one, and where a file would be replaced.
    """
    if folder is None and in_clone() and not os.environ.get(VARIABLE):
        raise DatasetError(f"{data_folder()}: this clone has the course's files: nothing to fetch")
    if not (base_url and digest):
        raise DatasetError("this version has no release to fetch from: clone the project instead")
    folder, url = Path(folder or data_folder()), f"{base_url.rstrip('/')}/{ARCHIVE}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:  # nothing is left of a killed download
            found = _download(url, file)
            if found != digest:
                raise DatasetError(f"{url}: SHA-256 is {found}, not {digest}: not this version's, not kept")
            written = _unpack(file, folder, url)
    except OSError as error:
        reason = error.strerror or error
        raise DatasetError(f"{folder}: {reason}: make room there, or set {VARIABLE}") from error
    print(f"{folder}: files written: {written}")
    return folder


def _download(url: str, file: IO[bytes]) -> str:
    """Writes what the server sends to `file` and returns its SHA-256. Raises DatasetError."""
    import requests  # its certificates are its own, where a Python on macOS may have none
    from tqdm.auto import tqdm
    from urllib3 import exceptions

    digest, size, end = hashlib.sha256(), 0, time.monotonic() + MAX_SECONDS
    try:
        with requests.get(url, stream=True, timeout=SILENCE) as answer:
            if not answer.ok:
                status = f"{answer.status_code} {answer.reason}"
                raise DatasetError(f"{url}: the server said {status}: is the address right?")
            said = answer.headers.get("Content-Length", "")
            length = int(said) if said.isdecimal() else None
            with tqdm(total=length, unit="B", unit_scale=True, desc=ARCHIVE) as bar:
                while part := answer.raw.read1(2**16):  # as much as has arrived: a slow server meets the end
                    size += len(part)
                    if max(size, length or 0) > MAX_BYTES:
                        raise DatasetError(f"{url}: more than {MAX_BYTES:,} bytes: is the address right?")
                    if time.monotonic() > end:
                        raise DatasetError(f"{url}: not complete after {MAX_SECONDS} s: try again later")
                    digest.update(part)
                    file.write(part)
                    bar.update(len(part))
    except (requests.RequestException, exceptions.HTTPError) as error:
        raise DatasetError(f"{url}: no connection, or it broke: check the network, try again") from error
    return digest.hexdigest()


def _unpack(file: IO[bytes], folder: Path, url: str) -> int:
    """Writes the files of an archive that are not in `folder` yet. Returns their number.

    Raises DatasetError where an entry is not a file of the course, and where a file would be replaced.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > MAX_BYTES:
                raise DatasetError(f"{url}: unpacks to more than {MAX_BYTES:,} bytes: not kept")
            for entry in entries:
                if not _is_ours(entry.filename):
                    raise DatasetError(f"{url}: has {entry.filename!r}, which is no file of the course")
            new = [entry for entry in entries if not _is_there(folder / entry.filename, entry)]
            for entry in new:
                path = folder / entry.filename
                with written_whole(path) as temporary, archive.open(entry) as content:
                    with open(temporary, "wb") as unpacked:
                        shutil.copyfileobj(content, unpacked)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError) as error:
        raise DatasetError(f"{url}: not a zip file, or damaged: {error}") from error
    return len(new)


def _is_ours(name: str) -> bool:
    """May an archive have a file of this name? Its parts must be plain names, so it stays in the folder."""
    plain = all(part[:1].isalnum() and part.isprintable() and ":" not in part for part in name.split("/"))
    return plain and "\\" not in name and (name == "LICENSE" or name.endswith(KINDS))


def _is_there(path: Path, entry: zipfile.ZipInfo) -> bool:
    """Is an entry's file there with the same content? Raises DatasetError where its content is another."""
    if not path.exists():
        return False
    size = path.stat().st_size if path.is_file() else None
    if size == entry.file_size and zlib.crc32(path.read_bytes()) == entry.CRC:
        return True
    raise DatasetError(f"{path}: differs from the release's file: move it away, or set {VARIABLE}")
