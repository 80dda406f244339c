"""Compiled templates, kept between runs in the user's cache folder.

Jinja compares a file's program, version and source; one that differs or is damaged is made again. If the
folder cannot be written, templates are compiled in every run.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import jinja2
from jinja2.bccache import Bucket

from boresight.pipeline.files.whole_file import write_whole
from boresight.pipeline.run.index_cache import cache_folder

__all__ = ["CompiledTemplates"]


class CompiledTemplates(jinja2.BytecodeCache):
    """Templates compiled by Jinja, one file each."""

    def load_bytecode(self, bucket: Bucket) -> None:
        """Take the compiled template from its file, if there is one."""
        with suppress(OSError), _path(bucket).open("rb") as file:
            bucket.load_bytecode(file)

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Write the compiled template into its file."""
        path = _path(bucket)
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, lambda target: target.write_bytes(bucket.bytecode_to_string()))


def _path(bucket: Bucket) -> Path:
    return cache_folder() / f"template-{bucket.key}"
