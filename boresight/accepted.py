"""The forms in which public functions take times, rotations, paths, images and numbers; their one reading.

Each `..._of` returns the one form that the package uses within, or raises a `ValueError` of one sentence that
names the argument, what was found and what is expected.
"""

from __future__ import annotations

import datetime
import inspect
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, Union

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.epoch import Epoch
from boresight.pipeline.errors import RawDataError, printable
from boresight.pipeline.files.object_store import is_address
from boresight.pipeline.files.whole_file import is_vacant
from boresight.pipeline.report.notebook import notebook_progress
from boresight.records.record import Floats

if TYPE_CHECKING:
    from astropy.time import Time

__all__ = ["ImageLike", "PathLike", "Progress", "RotationLike", "SiteLike", "Table", "TimeLike", "cell_of"]
__all__ += ["column_of", "count_of", "counted", "flag_of", "floats_of", "image_of", "in_unit"]
__all__ += ["instance_of", "is_symmetric"]
__all__ += ["label_of", "listed", "new_file_of", "new_folder_of", "no_progress", "number_of", "of_argument"]
__all__ += ["path_of", "pixels_of", "progress_of", "rotation_of", "rows_of", "shown", "site_of"]
__all__ += ["source_of", "utc_of", "vacant_folder_of", "values_by_column", "wrong"]

PathLike: TypeAlias = Union[str, "os.PathLike[str]"]
TimeLike: TypeAlias = Union[str, datetime.datetime, np.datetime64, "Time"]
RotationLike: TypeAlias = Rotation | NDArray[np.floating[Any]] | Sequence[Sequence[float]]
SiteLike: TypeAlias = Sequence[float] | NDArray[np.floating[Any]]
ImageLike: TypeAlias = NDArray[np.generic] | PathLike
Progress: TypeAlias = Callable[[str, int, int], object]
Table: TypeAlias = pd.DataFrame | Iterable[Mapping[str, Any]]

ORTHONORMAL = 1e-6  # of R Rᵀ: a matrix printed with seven digits
LONGEST_PATH, LONGEST_NAME = 4096, 255  # characters of a path and of each of its parts
LONGEST_SHOWN = 80  # characters of an argument that a message repeats
UNITS = {of: of for of in ("deg", "rad", "arcsec", "m", "s", "um", "mm", "km")} | {"px": "pix"}
UNITS |= {f"{a}_{b}": f"{a}/{b}" for a in ("m", "arcsec", "mrad", "deg") for b in ("s", "s2")}  # of a name
Kind = TypeVar("Kind")


def wrong(name: str, found: object, expected: str) -> ValueError:
    """The error for an argument, one sentence."""
    return ValueError(f"{name}: found {shown(found)}, expected {expected}")


def shown(found: object) -> str:
    """A value as one printable line: arrays by shape and type, others as Python writes them, cut short."""
    if isinstance(found, np.ndarray):
        return f"an array of shape {found.shape} and type {found.dtype}"
    try:
        text = printable(found if isinstance(found, str) and " " in found else repr(found)).replace("\n", " ")
    except Exception:  # whatever a foreign class raises
        text = "?"
    return text if len(text) <= LONGEST_SHOWN else f"{text[: LONGEST_SHOWN - 3]}..."


def path_of(value: object, name: str) -> Path:
    """A path of this machine."""
    if not isinstance(value, str | os.PathLike):
        raise wrong(name, value, "a path, as str or pathlib.Path")
    text = os.fspath(value)
    if not isinstance(text, str) or not text.strip() or "\0" in text:
        raise wrong(name, value, "a path that is not empty")
    if len(text) > LONGEST_PATH or max(map(len, Path(text).parts), default=0) > LONGEST_NAME:
        expected = f"at most {LONGEST_PATH} characters, {LONGEST_NAME} in each part"
        raise wrong(name, f"a path of {len(text)} characters", expected)
    return value if isinstance(value, Path) else Path(text)


def source_of(value: object, name: str) -> str | Path:
    """A path, or the address of a folder in a store (`s3://...`)."""
    return value if isinstance(value, str) and is_address(value) else path_of(value, name)


def new_folder_of(value: object, name: str) -> Path:
    """A path at which a folder is or can be made; an address and a file are refused."""
    path = path_of(value, name)
    if isinstance(value, str) and is_address(value):
        raise wrong(name, value, "a folder of this machine")
    if path.exists() and not path.is_dir():
        raise wrong(name, f"the file {path}", "a folder")
    return path


def vacant_folder_of(value: object, name: str) -> Path:
    """A path at which a folder can be made, or an empty one is."""
    path = new_folder_of(value, name)
    if not is_vacant(path):
        raise wrong(name, f"{path}, which holds files", "a new or empty folder")
    return path


def new_file_of(value: object, name: str) -> Path:
    """A path at which a file can be written; a folder is refused."""
    path = path_of(value, name)
    if path.is_dir() or not path.parent.is_dir():
        raise wrong(name, f"the path {path}", "a file in a folder that exists")
    return path


def flag_of(value: object, name: str) -> bool:
    """True or False."""
    if not isinstance(value, bool | np.bool_):
        raise wrong(name, value, "True or False")
    return bool(value)


def no_progress(*_told: object) -> None:
    """No progress is shown."""


def progress_of(value: object) -> Callable[[str, int, int], None]:
    """A function that is called with the stage, its tasks done, and all of them; by default it draws a bar in
    a notebook.
    """
    if value is no_progress:
        return notebook_progress()
    try:
        inspect.signature(value).bind("", 0, 1)  # type: ignore[arg-type]
    except Exception:  # of what is no function, or one of other arguments
        raise wrong("progress", value, "a function of stage, tasks done and all tasks") from None
    return value  # type: ignore[return-value]


def counted(items: Sequence[Kind], stage: str, told: Progress) -> Iterator[Kind]:
    """The items one by one; `told` hears how many are done."""
    told(stage, 0, len(items))
    for n, item in enumerate(items, 1):
        yield item
        told(stage, n, len(items))


def listed(value: object, name: str, what: str) -> list[Any]:
    """A list of several things: given as any iterable, a single path or text is a list of one."""
    if isinstance(value, str | os.PathLike):
        return [value]
    if isinstance(value, np.ndarray) and value.ndim == 2:  # one image
        return [value]
    try:
        if isinstance(value, bytes | dict):
            raise TypeError
        return list(value)  # type: ignore[call-overload]
    except Exception:  # of what is no sequence, or breaks when it is asked for its items
        raise wrong(name, value, f"a sequence of {what}") from None


def instance_of(value: object, kind: type[Kind], name: str) -> Kind:
    """The value itself, which must be of a class."""
    if not isinstance(value, kind):
        raise wrong(name, value, f"a {kind.__name__}")
    return value


def number_of(value: object, name: str, low: float = -math.inf, high: float = math.inf) -> float:
    """A finite number from `low` to `high`."""
    limits = "" if (low, high) == (-math.inf, math.inf) else f" from {low:g} to {high:g}"
    value = in_unit(value, name)
    try:
        if isinstance(value, str | bytes | bool):
            raise TypeError
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise wrong(name, value, f"a number{limits}") from None
    if not (math.isfinite(number) and low <= number <= high):
        raise wrong(name, number, f"a finite number{limits}")
    return number


def count_of(value: object, name: str, low: int = 0, high: int = 2**31 - 1) -> int:
    """A whole number from `low` to `high`."""
    limits = f" from {low}" + ("" if high == 2**31 - 1 else f" to {high}")
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise wrong(name, value, f"a whole number{limits}")
    if not low <= int(value) <= high:
        raise wrong(name, int(value), f"a whole number{limits}")
    return int(value)


def floats_of(value: object, name: str, shape: str, unit: str | None = None) -> Floats:
    """An array of floating-point numbers; `shape` is what the message asks for. A Quantity of astropy, or
    what states its units in `attrs`, is converted to `unit`; None: that of the name.
    """
    value = in_unit(value, name, unit)
    columns = [str(one) for one in value.columns] if isinstance(value, pd.DataFrame) else []
    if "".join(one[:1].lower() for one in columns) in ("yx", "xzy", "yxz", "yzx", "zxy", "zyx"):
        raise wrong(name, f"the columns {', '.join(columns)}", "x before y before z")
    try:
        if isinstance(value, str | bytes):
            raise TypeError
        array = np.asarray(value)
        if array.dtype.kind not in "iuf" and not (array.dtype == object and array.size):
            raise TypeError
        masked, numbers = bool(np.ma.is_masked(value)), array.astype(float)
    except Exception:  # of ragged lists, strings and foreign classes that pretend to be arrays
        raise wrong(name, value, f"numbers of shape {shape}") from None
    if masked:
        raise wrong(name, "an array with masked values", f"numbers of shape {shape}, none of them masked")
    return numbers


def is_symmetric(given: Floats) -> bool:
    """Whether matrices (..., M, M) are finite, and symmetric to the digits of 32 bits."""
    apart = np.abs(given - np.swapaxes(given, -1, -2))
    return bool(np.isfinite(given).all() and apart.max(initial=0.0) <= 1e-6 * np.abs(given).max(initial=0.0))


def in_unit(value: Any, name: str, unit: str | None = None) -> Any:
    """The value, or the numbers in `unit` of one that states its own; of a covariance in its square."""
    try:
        of_quantity = hasattr(value, "to_value")
        stated = value.unit if of_quantity else dict(getattr(value, "attrs", None) or {}).get("units")
    except Exception:  # of a foreign class
        stated = None
    if stated is None:
        return value
    last = name.split(", ")[-1].split(" ")[0].split("_")
    wanted = UNITS.get("_".join(last[-2:]), UNITS.get(last[-1], "")) if unit is None else unit
    try:
        from astropy.units import Quantity  # only where a unit is stated

        given = Quantity(np.asarray(value.value if of_quantity else value), stated)
        square = wanted and given.ndim > 1 and not given.unit.is_equivalent(wanted)
        return given.to_value(f"{wanted}2" if square else wanted)
    except Exception:
        expected = (
            f"numbers in {wanted}, or of a unit that converts to it" if wanted else "numbers without a unit"
        )
        raise wrong(name, f"values in {shown(str(stated))}", expected) from None


def image_of(value: Any, name: str) -> NDArray[Any]:
    """An image (H, W) of integers, computed now where it is a function."""
    expected = "raw counts (rows, columns) of type uint8 or uint16"
    pixels = pixels_of(value, name, expected)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise wrong(name, pixels, expected)
    return pixels


def pixels_of(value: Any, name: str, expected: str) -> NDArray[Any]:
    """Grey values (H, W), computed now where they are a function; masked pixels of floating ones are NaN."""
    try:
        given = value() if isinstance(value, Callable) else value  # type: ignore[arg-type]
        hidden = np.ma.getmaskarray(given) if np.ma.is_masked(given) else None
        pixels = np.asarray(given)
    except Exception as error:  # of a function, or of a foreign class that pretends to be an array
        raise wrong(name, value, f"{expected} ({shown(error)})") from error
    if pixels.ndim != 2 or pixels.dtype.kind not in "uif" or not pixels.size:
        raise wrong(name, pixels, expected)
    if hidden is None:
        return pixels
    if pixels.dtype.kind != "f":
        raise wrong(name, f"an array with {hidden.sum()} masked pixels", f"{expected}, none of them masked")
    return np.where(hidden, pixels.dtype.type(np.nan), pixels)


def rotation_of(value: object, name: str) -> Rotation:
    """One rotation: a scipy Rotation, or a (3, 3) matrix, orthonormal to 1e-6 and of determinant +1."""
    if isinstance(value, Rotation):
        if not value.single:
            raise wrong(name, f"{len(value)} rotations", "one rotation")
        return value
    matrix = floats_of(value, name, "(3, 3), or a scipy Rotation")
    if matrix.shape != (3, 3):
        raise wrong(name, matrix, "a scipy Rotation or a (3, 3) matrix")
    off = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if not off <= ORTHONORMAL:  # NaN is not
        raise wrong(name, f"a matrix whose R Rᵀ is {off:.1e} off the identity", f"at most {ORTHONORMAL:g}")
    if np.linalg.det(matrix) < 0.0:
        raise wrong(name, "a matrix of determinant -1", "+1: a rotation, no reflection")
    return Rotation.from_matrix(matrix)


def utc_of(value: object, name: str) -> str:
    """UTC in ISO form of a text in that form, a datetime (without time zone: UTC), a datetime64 or an astropy
    Time.
    """
    expected = 'UTC since 1972 such as "2026-03-01T12:00:00", a datetime or an astropy Time'
    text = _utc_text(value)
    if text is None:
        raise wrong(name, value, expected)
    try:
        Epoch.from_utc(text)
    except (ValueError, OverflowError) as error:
        raise wrong(name, text, f"{expected} ({error})") from error
    return text


def _utc_text(value: Any) -> str | None:
    if isinstance(value, str):
        return value
    if isinstance(value, datetime.datetime):
        if value != value:  # pandas' NaT is a datetime
            return None
        utc = value if value.tzinfo is None else value.astimezone(datetime.UTC).replace(tzinfo=None)
        return utc.isoformat()  # of a pandas Timestamp with its nanoseconds
    if getattr(getattr(value, "dtype", None), "kind", "") == "M" and value.ndim == 0:  # also of xarray
        instant: Any = np.asarray(value)[()]
        return _utc_text(pd.Timestamp(instant))  # as datetime64[ns] 2609 would be 2024
    if type(value).__module__.startswith("astropy.time") and getattr(value, "isscalar", False):
        precise = value.utc.copy(format="isot")
        precise.precision = 9
        return str(precise.value)
    return None


def site_of(value: object, name: str = "site") -> tuple[float, float, float]:
    """(latitude deg, longitude deg, height m) of a place on the ground."""
    expected = "(latitude deg, longitude deg, height m)"
    place = floats_of(value, name, f"(3,): {expected}")
    if place.shape != (3,) or not np.isfinite(place).all():
        raise wrong(name, value, f"{expected}, finite numbers")
    lat, lon, height = place.tolist()
    if not (abs(lat) <= 90.0 and abs(lon) <= 360.0 and -500.0 <= height <= 9000.0):
        raise wrong(name, (lat, lon, height), f"{expected}, the height from -500 to 9000 m")
    return lat, lon, height


def rows_of(table: Table, name: str) -> list[Mapping[str, Any]]:
    """A table as mappings, one a row."""
    if isinstance(table, pd.DataFrame):
        full = _with_places(table, name)
        rows: list[Any] = [dict(zip(full.columns, values)) for values in full.itertuples(index=False)]
    elif isinstance(table, str | bytes | Mapping):
        raise wrong(name, table, "a DataFrame or a sequence of mappings")
    else:
        rows = listed(table, name, "mappings, or a DataFrame")
    for n, row in enumerate(rows):
        if not isinstance(row, Mapping):
            raise wrong(f"{name}, row {n}", row, "a mapping of columns")
    if not rows:
        raise wrong(name, "no rows", "at least one")
    return rows


def _with_places(table: Any, name: str) -> Any:
    """The table; of a GeoDataFrame with lat_deg and lon_deg of its points and, of points with heights,
    height_m, unless it has such columns.
    """
    if (crs := getattr(table, "crs", None)) is None and not hasattr(table, "to_crs"):
        return table
    points = table.geometry
    if crs is None or crs.is_compound or not (points.geom_type == "Point").all() or points.is_empty.any():
        found = f"{', '.join(map(str, points.geom_type.unique()))} in {None if crs is None else crs.name}"
        raise wrong(name, found, "points in a reference system, whose heights, if any, are ellipsoidal")
    raised = bool(points.has_z.all())
    at = points.to_crs(4979 if raised else 4326)
    places = {"lat_deg": at.y, "lon_deg": at.x} | ({"height_m": at.z} if raised else {})
    return table.assign(**{key: places[key] for key in places if key not in table.columns})


def cell_of(row: Mapping[str, Any], key: str, name: str, n: int) -> Any:
    """A cell of row `n` of a table."""
    if key not in row:
        raise wrong(f"{name}, row {n}", f"columns {', '.join(map(str, row))}", f"also {key}")
    return row[key]


def column_of(
    rows: Sequence[Mapping[str, Any]],
    key: str,
    name: str,
    read: Callable[[Any, str], Kind],
    otherwise: object = None,
) -> list[Kind]:
    """A column of a table by a function of this module; `otherwise` stands in rows without it, if stated."""
    full = rows if otherwise is None else [{key: otherwise, **row} for row in rows]
    return [read(cell_of(row, key, name, n), f"{name}, row {n}, {key}") for n, row in enumerate(full)]


def values_by_column(rows: Sequence[Mapping[str, Any]], keys: Iterable[str], name: str) -> list[list[Any]]:
    """Columns of a table, each read as its key asks: texts, instants, counts; all others are numbers."""
    read: dict[str, Callable[[Any, str], Any]] = {"ccd": count_of, "time": utc_of}
    read |= dict.fromkeys(("id", "strip", "height_kind", "kind"), label_of)
    return [column_of(rows, key, name, read.get(key, number_of)) for key in keys]


def label_of(value: Any, name: str) -> str:
    """A name, or the whole number that stands for one."""
    if isinstance(value, bool) or not isinstance(value, str | int | np.integer):
        raise wrong(name, value, "a text")
    return str(value)


def of_argument(name: str, error: RawDataError) -> ValueError:
    """What is wrong with an argument that a reader of files has examined."""
    return ValueError(f"{name}, {error.field}: found {error.found}, expected {error.expected}")
