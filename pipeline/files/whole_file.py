"""A file that is on the disk as a whole or not at all, whatever happens while it is written."""

from __future__ import annotations

import errno
import os
import uuid
from pathlib import Path
from typing import Any

__all__ = ["write_whole"]


def write_whole(path: Path, write: Any) -> None:
    """Have `write(temporary path)` make a file beside `path`, flush it to the disk and give it its name.

    An `OSError` names `path`, whatever library it comes from.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        write(temporary)
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)
