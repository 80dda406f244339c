"""Read TOML, CSV and JSON files; errors name file, field, found and expected.

Nothing in a file is executed: values are text and numbers, and paths stay inside the dump.
"""

from __future__ import annotations

import csv
import io
import json
import re
import stat
import tomllib
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from boresight.pipeline.errors import RawDataError

__all__ = [
    "NUMBER",
    "check_regular",
    "path_inside",
    "read_json",
    "read_table",
    "read_text",
    "read_toml",
    "toml_tables",
]

Model = TypeVar("Model", bound=BaseModel)
MAX_TEXT_BYTES = 256 * 2**20
MAX_TOML_BYTES = 2**20
MAX_KEY_PARTS = 32  # of a dotted key; the parser's time grows with the square
MAX_ROWS = 500_000  # of a table; a record takes 1 kB
NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"  # a regular expression
PLAIN_NUMBER = "a finite number in ASCII digits"
_PLAIN_NUMBER = re.compile(NUMBER)
_STRING_OR_COMMENT = re.compile(
    r'''"""(?:\\.|[^\\])*?(?:"""|\Z)|\'{3}.*?(?:\'{3}|\Z)|"(?:\\.|[^"\\\n])*(?:"|$)|'[^'\n]*(?:'|$)|\#[^\n]*''',
    re.DOTALL | re.MULTILINE,
)


def path_inside(root: Path, relative: str, *, file: str, field: str) -> Path:
    """`root / relative`; `RawDataError` if it leaves `root` (absolute, with `..`, or through a link)."""
    expected = "a path inside the dump, relative to it, with / between its parts and no .."
    parts = relative.split("/")
    if (
        not relative.isprintable()
        or "\\" in relative
        or PureWindowsPath(relative).drive
        or any(part in ("", ".", "..") for part in parts)
    ):
        raise RawDataError(file, field, relative, expected)
    path = root.joinpath(*parts)
    try:
        resolved, home = path.resolve(), root.resolve()
    except (OSError, RuntimeError) as error:  # a loop of links
        raise RawDataError(file, field, f"{relative} ({error})", expected) from error
    if not resolved.is_relative_to(home):
        raise RawDataError(file, field, f"{relative}, a link to a place outside", expected)
    return path


def check_regular(path: Path, file: str, expected: str) -> int:
    """Size in bytes of a regular file; `RawDataError` for a FIFO, a device (opening it may block) or none."""
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        missing = isinstance(error, (FileNotFoundError, NotADirectoryError, ValueError))
        found = "no such file" if missing else f"{getattr(error, 'strerror', None) or error}"
        raise RawDataError(file, "file", found, expected) from error
    if not stat.S_ISREG(status.st_mode):
        found = "a folder" if stat.S_ISDIR(status.st_mode) else "a device, FIFO or socket"
        raise RawDataError(file, "file", found, expected)
    return status.st_size


def read_text(path: Path, file: str, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of a UTF-8 file without byte-order mark; `RawDataError` if it is too large or not UTF-8."""
    if (size := check_regular(path, file, "a readable file")) > max_bytes:
        raise RawDataError(file, "file", f"{size} bytes", f"at most {max_bytes} bytes of text")
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise RawDataError(file, "file", error.strerror or str(error), "a readable file") from error
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        found = f"byte 0x{raw[error.start]:02x}"
        raise RawDataError(file, f"byte {error.start}", found, "text in UTF-8") from error


def toml_tables(path: Path, file: str) -> dict[str, Any]:
    """The tables of a TOML file; `RawDataError` if it is not TOML."""
    text = read_text(path, file, MAX_TOML_BYTES)
    pieces = re.split(r"[,=\[\]{}\n]", _STRING_OR_COMMENT.sub("", text))
    if (parts := 1 + max(piece.count(".") for piece in pieces)) > MAX_KEY_PARTS:
        raise RawDataError(file, "text", f"a key of {parts} parts", f"at most {MAX_KEY_PARTS} parts")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # an integer of too many digits is a plain ValueError
        found = str(error) or type(error).__name__
        where = re.search(r"line \d+", found)
        raise RawDataError(file, where.group() if where else "text", found, "TOML 1.0") from error


def read_json(path: Path, file: str) -> dict[str, Any]:
    """The object in a JSON file of a result; `RawDataError` if there is none."""
    text = read_text(path, file)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RawDataError(file, "JSON", str(error), "JSON that `calibrate` wrote") from error
    if not isinstance(content, dict):
        raise RawDataError(file, "JSON", type(content).__name__, "an object, as `calibrate` wrote it")
    return content


def read_toml(path: Path, model: type[Model], file: str) -> Model:
    """A TOML file as a record of type `model`; `RawDataError` if it does not agree."""
    content = toml_tables(path, file)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise _raw_data_error(error, model, file, "") from error


def read_table(path: Path, model: type[Model], file: str) -> list[Model]:
    """The rows of a CSV file (RFC 4180, header line) as records of `model`; `RawDataError` if not valid."""
    text = read_text(path, file)
    expected = list(model.model_fields)
    numeric = [name for name, field in model.model_fields.items() if field.annotation in (int, float)]
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    records: list[Model] = []
    try:
        header = [name.strip() for name in next(rows, [])]
        _check_header(header, expected, file)
        for cells in rows:
            if not cells:
                continue
            line = f"line {rows.line_num}"
            if len(records) == MAX_ROWS:
                raise RawDataError(file, line, f"more than {MAX_ROWS} rows", f"at most {MAX_ROWS} rows")
            if len(cells) != len(header):
                raise RawDataError(file, line, f"{len(cells)} cells", f"{len(header)} cells")
            row = dict(zip(header, cells))
            for name in numeric:
                if not _PLAIN_NUMBER.fullmatch(row[name].strip(" ")):
                    raise RawDataError(file, f"{line}, {name}", row[name], PLAIN_NUMBER)
            try:
                records.append(model.model_validate(row))
            except ValidationError as error:
                raise _raw_data_error(error, model, file, f"{line}, ") from error
    except csv.Error as error:
        raise RawDataError(file, f"line {rows.line_num}", str(error), "comma-separated values") from error
    return records


def _check_header(header: Sequence[str], expected: Sequence[str], file: str) -> None:
    if missing := [name for name in expected if name not in header]:
        raise RawDataError(file, f"column {missing[0]}", "no such column", f"columns {', '.join(expected)}")
    if unknown := [name for name in header if name not in expected]:
        raise RawDataError(
            file, f"column {unknown[0]}", "an unknown column", f"columns {', '.join(expected)}"
        )
    if len(set(header)) != len(header):
        raise RawDataError(file, "header", ", ".join(header), "each column once")


def _raw_data_error(error: ValidationError, model: type[BaseModel], file: str, prefix: str) -> RawDataError:
    """The first of pydantic's errors as a `RawDataError`, with the field's description."""
    first: Any = error.errors(include_url=False)[0]
    field = ".".join(str(part) for part in first["loc"]) or "file"
    others = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    kind, message = first["type"], first["msg"]
    found: object
    if kind == "missing":
        found, expected = "nothing", "this key"
    elif kind == "extra_forbidden":
        found, expected = "an unknown key", "only keys of the format's description"
    else:
        found = first["input"]
        if isinstance(first["input"], dict):
            found = "keys " + ", ".join(map(str, first["input"]))
        meaning = _description(model, first["loc"])
        expected = message[0].lower() + message[1:] + (f" ({meaning})" if meaning else "")
    return RawDataError(file, prefix + field, found, expected + others)


def _description(model: type[BaseModel], location: Sequence[int | str]) -> str:
    """The description of the field at a location of pydantic's error, or ""."""
    text = ""
    for part in location:
        if isinstance(part, str) and part in model.model_fields:
            info = model.model_fields[part]
            text = info.description or ""
            inner = [kind for kind in (info.annotation, *get_args(info.annotation)) if isinstance(kind, type)]
            model = next((kind for kind in inner if issubclass(kind, BaseModel)), model)
    return text
