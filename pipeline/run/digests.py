"""Digests of what a result depends on: arrays, settings, content of files, source code."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import json
import platform
import re
from collections.abc import Iterator, Mapping
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

import erfa
import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from boresight.pipeline import __version__
from boresight.pipeline.files.content import content_digest

__all__ = ["digest", "files_in", "numerical_program", "numerical_versions", "rounded_digest", "sources_of"]

# Import statement of a module: `from` what, which names; or `import` what.
_IMPORT = re.compile(r"^\s*(?:from\s+([\w.]+)\s+import\s+(\([^)]*\)|[^\n]*)|import\s+([\w.]+))", re.MULTILINE)


def digest(*values: Any) -> str:
    """32 hexadecimal digits that change when anything in `values` does.

    A `Path` stands for the content of its file; its name and times do not matter.
    """
    state = hashlib.blake2b(digest_size=16)
    for value in values:
        _feed(state, value)
    return state.hexdigest()


def rounded_digest(content: Any) -> str:
    """`digest` of JSON with numbers to 10 digits: files of one camera differ by rounding of units."""
    return digest(json.loads(json.dumps(content), parse_float=lambda number: f"{float(number):.10g}"))


def files_in(value: Any) -> Iterator[Path]:
    """Paths in a value, of which `digest` reads the content."""
    if isinstance(value, Path):
        yield value
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            if field.init:
                yield from files_in(getattr(value, field.name))
    elif isinstance(value, Mapping):
        for one in value.values():
            yield from files_in(one)
    elif isinstance(value, (tuple, list)):
        for one in value:
            yield from files_in(one)


def _feed(state: Any, value: Any) -> None:
    if isinstance(value, bytes):
        state.update(b"bytes:%d:%b;" % (len(value), value))
    elif value is None or isinstance(value, (bool, int, float, str, np.number, np.bool_)):
        state.update(f"{type(value).__name__}:{value!r};".encode())
    elif isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        state.update(f"array:{array.dtype.str}:{array.shape};".encode())
        state.update(array.astype(str).tobytes() if array.dtype == object else array.tobytes())
    elif isinstance(value, Rotation):
        _feed(state, value.as_quat())
    elif isinstance(value, Path):
        try:
            state.update(f"file:{content_digest(value)};".encode())
        except OSError as error:
            state.update(f"no file:{error.errno};".encode())
    elif isinstance(value, Enum):
        _feed(state, value.name)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        state.update(f"{type(value).__name__}(".encode())
        for field in dataclasses.fields(value):
            if field.init:
                state.update(f"{field.name}=".encode())
                _feed(state, getattr(value, field.name))
        state.update(b")")
    elif isinstance(value, Mapping):
        state.update(f"map:{len(value)};".encode())
        for key in sorted(value):
            _feed(state, key)
            _feed(state, value[key])
    elif isinstance(value, (tuple, list)):
        state.update(f"list:{len(value)};".encode())
        for item in value:
            _feed(state, item)
    else:
        raise TypeError(f"no digest for a {type(value).__name__}")


@cache
def numerical_program(*modules: str) -> str:
    """Version of the program, and a digest of the sources of `modules`, of all that they import from the same
    package, and of the libraries of numbers: for what reads no file.
    """
    sources = {name: text for name, text in sources_of(*modules).items() if type(text) is bytes}
    return f"{__version__} {digest(sources, numerical_versions())}"


def sources_of(*modules: str) -> dict[str, Any]:
    """Sources of modules (or of all in packages) and of their imports; paths of data files beside them."""
    sources: dict[str, Any] = {}
    todo = [name for root in modules for name in _with_submodules(root)]
    while todo:
        name = todo.pop()
        if name in sources or (module := _module(name)) is None:
            continue
        sources[name], imported, data = module
        todo += imported
        if data is not None:
            sources[f"data of {name}"] = data
    return sources


@cache
def _module(name: str) -> tuple[bytes, list[str], list[Path] | None] | None:
    """Source of a module, its imports from its package, data files of a package; None: no such module."""
    if (file := _file_of(name)) is None:
        return None
    source, imported, data = file.read_bytes(), [], None
    if "." in name:  # what the top-level package imports is for its users
        imported = [name.rpartition(".")[0], *_imports(source, name.partition(".")[0])]
    if file.name == "__init__.py":
        data = sorted(path for path in file.parent.joinpath("data").glob("*") if path.is_file())
    return source, imported, data


def numerical_versions() -> dict[str, str]:
    """Versions of Python and of the libraries of numbers that every room uses."""
    libraries = {"numpy": np.__version__, "scipy": scipy.__version__, "pyerfa": erfa.__version__}
    return {"python": platform.python_version()} | libraries


def _with_submodules(name: str) -> list[str]:
    file = _file_of(name)
    if file is None or file.name != "__init__.py":
        return [name]
    inner = [path.relative_to(file.parent).with_suffix("") for path in file.parent.rglob("*.py")]
    return [name, *(".".join((name, *path.parts)) for path in inner if path.name != "__init__")]


@cache
def _file_of(name: str) -> Path | None:
    """Source file of a module, by its place below the top-level package; None if there is none."""
    package, _, last = name.rpartition(".")
    if not package:
        spec = importlib.util.find_spec(name)
        folders = spec.submodule_search_locations if spec else None
        return Path(folders[0], "__init__.py") if folders else None
    outer = _file_of(package)
    if outer is None or outer.name != "__init__.py":
        return None
    candidates = outer.with_name(last) / "__init__.py", outer.with_name(f"{last}.py")
    return next((file for file in candidates if file.is_file()), None)


def _imports(source: bytes, package: str) -> Iterator[str]:
    """Names below `package` that a source imports, at its top or within functions; some may be no modules."""
    for match in _IMPORT.finditer(source.decode("utf-8")):
        module, names, plain = match.groups()
        if (module or plain).partition(".")[0] == package:
            yield plain or module
            yield from (f"{module}.{name}" for name in re.findall(r"\w+", names or ""))
