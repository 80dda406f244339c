"""Which files of a dump have the same content. Only files of equal size are read, first in part."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from boresight.pipeline.files.content import content_digest

__all__ = ["equal_files", "grouped"]

SAMPLE_BYTES = 4096  # at the beginning, in the middle and at the end of a file, compared before all bytes are

Key = TypeVar("Key")


def equal_files(paths: Mapping[Key, Path]) -> list[list[Key]]:
    """Groups of two and more files with the same bytes, by their keys; what cannot be read is in none."""
    of_size = grouped(paths, lambda key: paths[key].stat().st_size)
    alike = [part for group in of_size for part in grouped(group, lambda key: _sample(paths[key]))]
    return [part for group in alike for part in grouped(group, lambda key: content_digest(paths[key]))]


def grouped(keys: Iterable[Key], what: Callable[[Key], object]) -> list[list[Key]]:
    """Groups of two and more keys with the same `what`; those for which it raises `OSError` are in none."""
    groups = defaultdict(list)
    for key in keys:
        with suppress(OSError):
            groups[what(key)].append(key)
    return [group for group in groups.values() if len(group) > 1]


def _sample(path: Path) -> bytes:
    size = path.stat().st_size
    with path.open("rb") as stream:
        parts = []
        for share in (0.0, 0.5, 1.0):
            stream.seek(int(share * max(size - SAMPLE_BYTES, 0)))
            parts.append(stream.read(SAMPLE_BYTES))
    return b"".join(parts)
