"""Writing files: whole or not at all."""

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path

from safetensors import SafetensorError


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Write to the path that this yields: it takes the place of `path` when the block ends without an error.

    Whoever looks finds the old file or the new one, whole, also after a crash. Makes the folders above.
    Raises OSError where there is no room or no permission.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")  # no other machine's, either
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except SafetensorError as error:  # what it makes of a full disk
        raise OSError(f"{path}: {error}") from error
    finally:
        temporary.unlink(missing_ok=True)
