"""Read TOML, CSV and JSON files; errors name file, field, found and expected.

Nothing in a file is executed: values are text and numbers, and paths stay inside the dump.
"""

from __future__ import annotations

import csv
import gzip
import io
import json
import re
import tomllib
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path, PureWindowsPath
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.content import check_extent, limited_content

__all__ = [
    "NUMBER",
    "PLAIN_NUMBER",
    "check_number",
    "csv_rows",
    "each_once",
    "expected_of",
    "json_if_there",
    "path_inside",
    "read_json",
    "read_message",
    "read_table",
    "read_text",
    "read_toml",
    "toml_tables",
    "unpacked",
    "utf8_text",
]

Model = TypeVar("Model", bound=BaseModel)
# Largest file that is read as text, and as TOML: far above any of a mission. One character beyond 0xffff
# makes Python take 4 bytes for each.
MAX_TEXT_BYTES = 128 * 2**20
MAX_TOML_BYTES = 2**20
_GZIP = b"\x1f\x8b"  # first bytes of a gzip file
MAX_KEY_PARTS = 32  # of a dotted key; the parser's time grows with the square
MAX_WRONG_ROWS = 100  # of a table, before it is given up
MAX_ROWS = 500_000  # of a table; a record takes 1 kB
MAX_LINE = 2**20  # characters of a line of a table
MAX_JSON_VALUES = 2**22  # of a file; an empty object takes 64 bytes
# Regular expression of a decimal number in the text files of a dump: ASCII digits, optional sign, point and
# exponent; no nan, no inf.
NUMBER = r"[+-]?+(?:[0-9]++\.?+[0-9]*+|\.[0-9]++)(?:[eE][+-]?+[0-9]++)?+"
PLAIN_NUMBER = "a finite number in ASCII digits"  # the same in messages
_PLAIN_NUMBER = re.compile(NUMBER)  # of a whole text
_LINE = re.compile(r"[^\r\n]*(?:\r\n?|\n)|[^\r\n]+")
# Strings and comments of TOML, of any of its four kinds of quotes, closed or not.
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


def read_text(path: Path, file: str, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of a UTF-8 file without byte-order mark; `RawDataError` if it is too large or not UTF-8."""
    return utf8_text(limited_content(path, file, "a readable file", max_bytes), file)


def read_message(path: Path, file: str) -> str:
    """The text of a message, as `read_text` has it, plain or `unpacked`."""
    raw = limited_content(path, file, "a readable file", MAX_TEXT_BYTES)
    return utf8_text(unpacked(raw, file, MAX_TEXT_BYTES), file)


def unpacked(raw: bytes, file: str, max_bytes: int) -> bytes:
    """The content of a file that is compressed with gzip (RFC 1952), of another one the bytes themselves;
    `RawDataError` for more than `max_bytes`, or for damage.
    """
    if not raw.startswith(_GZIP):
        return raw
    with refusing(file, "gzip", "a whole gzip file", (OSError, EOFError, zlib.error)):
        with gzip.GzipFile(fileobj=io.BytesIO(raw)) as stream:
            content = stream.read(max_bytes + 1)
    check_extent(file, "unpacked", (len(content),), max_bytes, "bytes")
    return content


def utf8_text(raw: bytes, file: str) -> str:
    """The text of bytes in UTF-8, without a byte-order mark; `RawDataError` for others."""
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        found, expected = f"byte 0x{raw[error.start]:02x}", "text in UTF-8 (of a spreadsheet: CSV UTF-8)"
        raise RawDataError(file, f"byte {error.start}", found, expected) from error


def toml_tables(path: Path, file: str) -> dict[str, Any]:
    """The tables of a TOML file; `RawDataError` if it is not TOML."""
    text = read_text(path, file, MAX_TOML_BYTES)
    pieces = re.split(r"[,=\[\]{}\n]", _STRING_OR_COMMENT.sub("", text))
    if (parts := 1 + max(piece.count(".") for piece in pieces)) > MAX_KEY_PARTS:
        raise RawDataError(file, "text", f"a key of {parts} parts", f"at most {MAX_KEY_PARTS} parts")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # an integer of too many digits is a plain ValueError
        reason = str(error) or type(error).__name__
        where = re.search(r"line (\d+)", reason)
        if where is None:
            raise RawDataError(file, "text", reason, "TOML 1.0: KEY = VALUE, text in quotes") from error
        line = text.split("\n")[int(where[1]) - 1].strip()
        expected = f"TOML 1.0: KEY = VALUE, text in quotes ({reason[0].lower()}{reason[1:]})"
        raise RawDataError(file, where[0], line, expected) from error


def read_json(path: Path, file: str = "") -> dict[str, Any]:
    """The object in a JSON file of a result; `RawDataError` about `file`, or the path, if there is none."""
    file = file or str(path)
    if not path.exists():
        expected = "the folder of a result that `boresight calibrate` finished; see `boresight status`"
        raise RawDataError(file, "file", "no such file", expected)
    text = read_text(path, file)
    check_extent(file, "values", (sum(map(text.count, ",[{")),), MAX_JSON_VALUES, "values")
    with refusing(file, "JSON", "JSON that `calibrate` wrote", (ValueError, RecursionError)):
        content = json.loads(text, parse_constant=_no_number)
    if not isinstance(content, dict):
        raise RawDataError(file, "JSON", type(content).__name__, "an object, as `calibrate` wrote it")
    return content


def json_if_there(path: Path) -> dict[str, Any]:
    """As `read_json`; empty where there is no such file."""
    return read_json(path) if path.is_file() else {}


def _no_number(word: str) -> float:
    raise ValueError(f"{word}, which JSON has not")


def read_toml(path: Path, model: type[Model], file: str) -> Model:
    """A TOML file as a record of type `model`; `RawDataError` if it does not agree."""
    content = toml_tables(path, file)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise _raw_data_error(error, model, file, "") from error


def read_table(path: Path, model: type[Model], file: str, least: str = "") -> list[Model]:
    """The rows of a CSV file (RFC 4180, header line) as records of `model`; `RawDataError` if not valid, or
    where there is none and `least` says what is needed: "at least one strip".
    """
    required = [name for name, field in model.model_fields.items() if field.is_required()]
    optional = [name for name in model.model_fields if name not in required]
    numeric = [name for name, field in model.model_fields.items() if field.annotation in (int, float)]
    records: list[Model] = []
    wrong: list[RawDataError] = []
    for line, row in csv_rows(path, required, optional, file):
        try:
            for name in numeric:
                if not _PLAIN_NUMBER.fullmatch(row[name].strip(" ")):
                    check_number(row[name], file, f"{line}, {name}")
            records.append(model.model_validate(row))
        except RawDataError as error:
            wrong.append(error)
        except ValidationError as error:
            wrong.append(_raw_data_error(error, model, file, f"{line}, "))
        if len(wrong) == MAX_WRONG_ROWS:
            break
    if wrong:
        wrong[0].others = tuple(wrong[1:])
        raise wrong[0]
    if least and not records:
        raise RawDataError(file, "rows", "none", least)
    return records


def each_once(ids: Sequence[str], file: str) -> None:
    """`RawDataError` where an id occurs twice, or two differ in case only: files are named by them."""
    if twice := [f"{name} {n} times" for name, n in Counter(ids).items() if n > 1]:
        raise RawDataError(file, "id", ", ".join(twice[:5]), "each id once")
    of_name = {name.lower(): name for name in ids}
    if alike := [f"{name} and {of_name[name.lower()]}" for name in ids if of_name[name.lower()] != name]:
        raise RawDataError(file, "id", ", ".join(alike[:5]), "ids that differ in more than case")


def csv_rows(
    path: Path, required: Sequence[str], optional: Sequence[str], file: str
) -> Iterator[tuple[str, dict[str, str]]]:
    """Rows as ("line N", cells by column); `RawDataError` for other columns or numbers of cells."""
    rows = csv.reader(_lines(read_text(path, file), file), strict=True)
    count = 0
    try:
        header = [name.strip() for name in next(rows, [])]
        _check_header(header, required, optional, file)
        for cells in rows:
            if not cells:
                continue
            line = f"line {rows.line_num}"
            if (count := count + 1) > MAX_ROWS:
                check_extent(file, line, (count,), MAX_ROWS, "rows")
            if len(cells) != len(header):
                raise RawDataError(file, line, f"{len(cells)} cells", f"{len(header)} cells")
            yield line, dict(zip(header, cells))
    except csv.Error as error:
        raise RawDataError(file, f"line {rows.line_num}", str(error), "comma-separated values") from error


def _lines(text: str, file: str) -> Iterator[str]:
    """Lines with their ends, one in memory at a time; `RawDataError` for one that is too long."""
    for n, line in enumerate(_LINE.finditer(text), start=1):
        if (n_characters := len(line[0])) > MAX_LINE:
            check_extent(file, f"line {n}", (n_characters,), MAX_LINE, "characters")
        yield line[0]


def check_number(cell: str, file: str, field: str) -> float:
    """The number in a cell; `RawDataError` for anything but a finite number in ASCII digits."""
    if not _PLAIN_NUMBER.fullmatch(cell.strip(" ")):
        raise RawDataError(file, field, cell or "nothing", PLAIN_NUMBER)
    return float(cell)


def _check_header(header: Sequence[str], required: Sequence[str], optional: Sequence[str], file: str) -> None:
    expected = f"columns {', '.join(required)}" + (f" and perhaps {', '.join(optional)}" if optional else "")
    if len(header) == 1 and (other := [mark for mark in ";\t|" if mark in header[0]]):
        found = f"columns separated by {other[0]!r}"
        raise RawDataError(file, "header", found, "columns separated by commas")
    if missing := [name for name in required if name not in header]:
        raise RawDataError(file, f"column {missing[0]}", "no such column", expected)
    if unknown := [name for name in header if name not in (*required, *optional)]:
        raise RawDataError(file, f"column {unknown[0]}", "an unknown column", expected)
    if len(set(header)) != len(header):
        raise RawDataError(file, "header", ", ".join(header), "each column once")


def _raw_data_error(error: ValidationError, model: type[BaseModel], file: str, prefix: str) -> RawDataError:
    """The first of pydantic's errors as a `RawDataError`, with the field's description and the others."""
    every: list[Any] = error.errors(include_url=False)
    missing = {str(one["loc"][-1]): one for one in every if one["type"] == "missing"}
    unknown = [one for one in every if one["type"] == "extra_forbidden"]
    typos = [(one, get_close_matches(str(one["loc"][-1]), missing, 1)) for one in unknown]
    meant = {id(one): close[0] for one, close in typos if close}
    spared = {id(missing[name]) for name in meant.values()}
    ordered = sorted((one for one in every if id(one) not in spared), key=lambda one: id(one) not in meant)
    more = f" (and {len(ordered) - 1} more)" if len(ordered) > 1 else ""
    first, *others = (
        _one_error(one, model, file, prefix, meant.get(id(one), ""), "" if n else more)
        for n, one in enumerate(ordered)
    )
    first.others = tuple(others)
    return first


def _one_error(
    error: Mapping[str, Any], model: type[BaseModel], file: str, prefix: str, meant: str, more: str
) -> RawDataError:
    """One of pydantic's errors; `meant` is the key that an unknown one stands for."""
    field = ".".join(str(part) for part in error["loc"]) or "file"
    meaning = _description(model, error["loc"])
    meaning = f" ({meaning})" if meaning else ""
    found = error["input"]
    if error["type"] == "value_error" and isinstance(found, dict):
        found, expected = expected_of(error), "values that are possible together"
    elif error["type"] == "missing":
        found, expected = "nothing", f"the key {error['loc'][-1]}{meaning}"
    elif error["type"] == "extra_forbidden":
        found, expected = "an unknown key", meant or "only keys of the format's description"
    else:
        found = f"keys {', '.join(map(str, found))}" if isinstance(found, dict) else found
        expected = expected_of(error) + meaning
    return RawDataError(file, prefix + field, found, expected + more)


def expected_of(error: Mapping[str, Any]) -> str:
    """What one of pydantic's errors asks for, in words of this program."""
    limits, message = error.get("ctx", {}), str(error["msg"])
    match error["type"]:
        case "greater_than_equal":
            return f"at least {limits['ge']:g}"
        case "less_than_equal":
            return f"at most {limits['le']:g}"
        case "literal_error":
            return str(limits["expected"]).replace(" or ", ", ").replace("'", '"')
        case "too_short" | "too_long":
            least = "min_length" in limits
            some = f"at least {limits['min_length']}" if least else f"at most {limits['max_length']}"
            return f"{some} values, not {limits['actual_length']}"
        case "string_too_short":
            return f"text of at least {limits['min_length']} characters"
        case "string_too_long":
            return f"text of at most {limits['max_length']} characters"
        case "value_error":
            return str(limits.get("error", message))
    return OF_KINDS.get(error["type"], message[0].lower() + message[1:])


OF_KINDS = {  # what other kinds of pydantic's errors ask for
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "an integer without quotes"),
    **dict.fromkeys(("float_type", "float_parsing"), "a number without quotes and unit"),
    **dict.fromkeys(("list_type", "tuple_type"), "a list: [.., ..]"),
    **dict.fromkeys(("model_type", "dict_type", "model_attributes_type"), "a table"),
    "finite_number": "a finite number",
    "string_type": "text in quotes",
    "bool_type": "true or false",
    "string_pattern_mismatch": "text of this form",
}


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
