"""Write a file so that it is on disk as a whole or not at all, whatever happens while it is written."""

from __future__ import annotations

import errno
import json
import math
import os
import platform
import re
import time
import uuid
import zlib
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from boresight.pipeline.errors import RawDataError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "is_vacant",
    "json_text",
    "make_own_folder",
    "remove_abandoned",
    "write_figure",
    "write_inside",
    "write_json",
    "write_text",
    "write_whole",
]

# Name of a file that is being written: digest of the host, process, random digits.
_TEMPORARY = re.compile(r"\..+\.boresight-([0-9a-f]{8})-([0-9]+)-[0-9a-f]{8}\.tmp")
_OTHER_HOST_S = 86_400.0  # after a day another machine's temporary file counts as abandoned


def write_whole(path: Path, write: Any) -> None:
    """Have `write(temporary path)` make a file beside `path`, flush it to the disk and rename it to `path`.

    Any `OSError` names `path`. If the process is killed, `remove_abandoned` finds what is left.
    """
    owner = f"{_host()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    temporary = path.with_name(f".{path.name}.boresight-{owner}.tmp")
    try:
        write(temporary)
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def is_vacant(folder: Path) -> bool:
    """Whether a folder is missing or empty, and may be filled."""
    return not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))


def make_own_folder(folder: Path) -> None:
    """Make a folder inside a result, whose parent is there; `RawDataError` for a link or a file."""
    with suppress(FileExistsError):
        folder.mkdir()
    if folder.is_symlink() or not folder.is_dir():
        found = "a link" if folder.is_symlink() else "a file"
        raise RawDataError(str(folder), "folder of the result", found, "a folder; remove what is there")


def write_inside(path: Path, write: Any) -> None:
    """`write_whole` into a folder of a result, made if missing; `RawDataError` where it has become a link."""
    make_own_folder(path.parent)
    write_whole(path, write)


def write_text(path: Path, text: str) -> None:
    """Write `text` in UTF-8."""
    write_whole(path, lambda target: target.write_text(text, encoding="utf-8"))


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write `content` as JSON, whole or not at all; null stands for what is not finite."""
    write_text(path, json_text(content) + "\n")


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure as PNG."""
    write_whole(path, lambda target: figure.savefig(target, format="png", dpi=120))


def remove_abandoned(folder: Path) -> None:
    """Remove the temporary files below `folder` that `write_whole` left in processes that no longer run."""
    for path in folder.rglob(".*.tmp"):
        if (match := _TEMPORARY.fullmatch(path.name)) and _abandoned(path, match[1], int(match[2])):
            path.unlink(missing_ok=True)


def _abandoned(path: Path, host: str, process: int) -> bool:
    if host != _host() or os.name != "posix":  # elsewhere signal 0 ends a process
        return path.is_file() and time.time() - path.stat().st_mtime > _OTHER_HOST_S
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return False


def _host() -> str:
    return f"{zlib.crc32(platform.node().encode()):08x}"


def json_text(content: Any, indent: int = 2) -> str:
    """`content` as JSON text; null stands for what is not finite, and a NumPy array becomes a list."""
    return json.dumps(_finite(content), indent=indent, allow_nan=False)


def _finite(content: Any) -> Any:
    if hasattr(content, "tolist"):  # arrays and numbers of NumPy
        content = content.tolist()
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
