"""Records: frozen dataclasses whose fields state shape, unit, frame and meaning once.

    @record
    class Detections:
        "Stars found in one image. Row n of every array is the same star."

        xy_px: Floats = array("N, 2", "centroids as (column, row)")
        flux_dn: Floats = array("N", "total above the background, DN")
        threshold: float = scalar("detection limit, sigmas of the background", default=5.0)

From this one declaration come the shape check at construction, the "Attributes" section of the docstring that
`help()` and the API pages show, and the columns of the tables on disk (`pipeline.files.record_tables`).
"""

from __future__ import annotations

import dataclasses
import inspect
import numbers
import re
from collections.abc import Callable, Sequence
from functools import cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar, cast, dataclass_transform, overload

__all__ = [
    "Bools",
    "Floats",
    "Ints",
    "RowRecord",
    "Texts",
    "array",
    "check_numbers",
    "concatenated",
    "inner",
    "record",
    "scalar",
    "shape_of",
    "together",
    "value_text",
]

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Bools = NDArray[np.bool_]
    Texts = NDArray[np.str_]
else:

    def __getattr__(name: str) -> Any:
        """An alias of array types, made when it is imported: records without arrays do not load NumPy."""
        kinds = {"Floats": "float64", "Ints": "int64", "Bools": "bool_", "Texts": "str_"}
        if name not in kinds:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        import numpy.typing  # records of texts and numbers alone are there before NumPy is

        globals()[name] = alias = numpy.typing.NDArray[getattr(numpy, kinds[name])]
        return alias


Record = TypeVar("Record")
T = TypeVar("T")
LARGEST_NUMBER = 1e300  # beyond it a number of a record is no measurement: products of two overflow
Dimension = tuple[str, int]  # a shared length plus a number; "" is the length 0
# Regular expression of one dimension of a shape: a number, or a capital letter plus or minus a number.
_DIMENSION = re.compile(r"(\d+)|([A-Z])(?:\s*([+-])\s*(\d+))?")


def array(shape: str, meaning: str, **options: Any) -> Any:
    """Declare an array field; `shape` is a list such as "N, 3", "K + 1" or "2, 2".

    A capital letter is a length that all fields of the record share; a number is that length. Rotations and
    tuples are arrays of one dimension. `meaning` states unit and frame; `options` are those of
    `dataclasses.field` (`default`, `default_factory`, `repr`). A field annotated `... | None` may be None.
    """
    dimensions = tuple(_dimension(part.strip()) for part in shape.split(",") if part.strip())
    options["metadata"] = {
        "shape": dimensions,
        "shape_text": f"({shape},)" if len(dimensions) == 1 else f"({shape})",
        "meaning": meaning,
    }
    return dataclasses.field(**options)


def scalar(meaning: str, **options: Any) -> Any:
    """Declare a field that is no array. `meaning` states unit and frame; `options` as in `array`."""
    options["metadata"] = {"meaning": meaning}
    return dataclasses.field(**options)


class inner(property, Generic[T]):  # declares, as `array` and `scalar` do
    """Declare an attribute of a record that this one holds, or what a function makes of one:
    `snr = inner[Floats]("star_list.snr", ...)`, `matches = inner[int]("hip", "number of stars", of=len)`.
    """

    def __init__(self, place: str, meaning: str, of: Callable[[Any], Any] | None = None) -> None:
        held = attrgetter(place)
        super().__init__(held if of is None else lambda record: of(held(record)))
        self.__doc__ = meaning

    if TYPE_CHECKING:

        def __get__(self, held_by: object, owner: type | None = None, /) -> T: ...  # type: ignore[override]


@overload
def record(cls: type[Record], /) -> type[Record]: ...


@overload
def record(*, kw_only: bool = ..., by_value: bool = ...) -> Callable[[type[Record]], type[Record]]: ...


@dataclass_transform(frozen_default=True, field_specifiers=(array, scalar, dataclasses.field))
def record(cls: Any = None, /, *, kw_only: bool = False, by_value: bool = False) -> Any:
    """Make a class a frozen dataclass with slots, compared by identity, that checks its arrays' shapes.

    With `by_value` it is compared, and can be a key, by its fields: for records of texts and numbers alone.

    Construction raises `ValueError` naming the field, its expected shape and the shape found. A
    `__post_init__` of the class runs after that check. Records of more than five fields take `kw_only=True`.
    """

    def decorate(cls: Any) -> Any:
        own = cls.__dict__.get("__post_init__")
        declared = [(name, f) for name, f in cls.__dict__.items() if isinstance(f, dataclasses.Field)]
        optional = {name for name, _ in declared if str(cls.__annotations__[name]).endswith("| None")}
        checked = tuple(
            (name, f.metadata["shape"], name in optional) for name, f in declared if "shape" in f.metadata
        )
        if checked:
            cls.__post_init__ = _post_init(cls.__name__, checked, own)
        # What `dataclasses` would compile for each class (two thirds of the time to import this package)
        # all records share: so not `frozen=True`.
        compared = {"eq": by_value, "unsafe_hash": by_value}
        made: Any = dataclasses.dataclass(init=False, repr=False, slots=True, kw_only=kw_only, **compared)(
            cls
        )
        made.__doc__, made.__signature__ = _documented(made), _Signature()
        made.__init__, made.__setstate__ = _assign, _restore
        made.__setattr__ = made.__delattr__ = _refuse_change
        if made.__repr__ is object.__repr__:  # else it has its own
            made.__repr__ = _text
        return made

    return decorate if cls is None else decorate(cls)


def _assign(self: Any, /, *given: Any, **named: Any) -> None:
    """`__init__` of all records."""
    cls: Any = type(self)
    places, taken, needed, setters, defaults, makers, after = _fields_of(cls)
    values = named if not given else dict(zip(places, given)) | named
    if len(values) != len(given) + len(named) or not needed <= values.keys() <= taken:
        _like(cls)(*given, **named)  # raises what Python says of such a call
    for name, make in makers:
        if name not in values:
            values[name] = make()
    for name, value in (defaults | values if defaults else values).items():
        setters[name](self, value)
    if after is not None:
        after(self)


@cache
def _fields_of(cls: Any) -> tuple[Any, ...]:
    """Fields by place, those that a call may name and those that it must, what sets each, defaults and their
    makers; what runs afterwards."""
    every = dataclasses.fields(cls)
    setters = {field.name: getattr(cls, field.name).__set__ for field in every}
    defaults = {field.name: field.default for field in every if field.default is not dataclasses.MISSING}
    makers = {f.name: f.default_factory for f in every if f.default_factory is not dataclasses.MISSING}
    taken = {field.name for field in every if field.init}
    needed, after = taken - defaults.keys() - makers.keys(), getattr(cls, "__post_init__", None)
    return cls.__match_args__, taken, needed, setters, defaults, makers.items(), after


@cache
def _like(cls: Any) -> Any:
    """A class with the same fields whose `__init__` is compiled by `dataclasses`."""
    declared: dict[str, Any] = {field.name: field for field in dataclasses.fields(cls)}
    about = {"__annotations__": {name: f.type for name, f in declared.items()}, "__module__": cls.__module__}
    names = {"__qualname__": cls.__qualname__, "__doc__": cls.__doc__}
    return dataclasses.dataclass(type(cls.__name__, (), declared | about | names))


class _Signature:
    """Of a record, for `inspect` and `help`."""

    def __get__(self, held: object, owner: type) -> inspect.Signature:
        return inspect.signature(_like(owner))


def _refuse_change(self: object, name: str, value: object = None) -> None:
    raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")


def _restore(self: object, state: tuple[None, dict[str, Any]]) -> None:
    for name, value in state[1].items():
        object.__setattr__(self, name, value)


def _text(self: Any) -> str:
    values = [f"{f.name}={getattr(self, f.name)!r}" for f in dataclasses.fields(self) if f.repr]
    return f"{type(self).__qualname__}({', '.join(values)})"


class RowRecord:
    """Base of records whose arrays have a row for each of the same things, as has a record of this kind that
    they hold: some of the rows, and those of several records.
    """

    __slots__ = ()

    def take(self, rows: Any) -> Self:
        """The rows with indices (M,), in that order, or of a mask (N,)."""
        held = {name: getattr(self, name) for name in _row_fields(self)}
        chosen = {name: _taken(value, rows) for name, value in held.items()}
        return cast(Self, dataclasses.replace(cast(Any, self), **chosen))

    @classmethod
    def together(cls, parts: Sequence[Self]) -> Self:
        """The rows of several, part after part; what has no rows is that of the first."""
        return together(parts)


def together(parts: Sequence[Record]) -> Record:
    """Records of one class, whose arrays have a row for each of the same things, as one."""
    columns = {name: [getattr(part, name) for part in parts] for name in _row_fields(parts[0])}
    joined = {name: concatenated(values) for name, values in columns.items()}
    return cast(Record, dataclasses.replace(cast(Any, parts[0]), **joined))


def _taken(value: Any, rows: Any) -> Any:
    if isinstance(value, tuple):
        import numpy as np

        return tuple(value[n] for n in np.arange(len(value))[rows].tolist())
    return value.take(rows) if isinstance(value, RowRecord) else value[rows]


def concatenated(values: Sequence[T]) -> T:
    """Arrays, rotations, tuples or records of rows, one after another; of one itself."""
    first: Any = values[0]
    if isinstance(first, tuple):
        return cast(T, sum(cast(Any, values), ()))
    if isinstance(first, RowRecord):
        return cast(T, first.together(cast(Any, values)))
    if hasattr(first, "dtype"):
        import numpy as np

        return cast(T, np.concatenate(cast(Any, values)))
    full: Any = [value for value in values if len(cast(Any, value))] or values
    return cast(T, type(first).concatenate(full) if len(full) > 1 else full[0])


def shape_of(field: dataclasses.Field[Any]) -> tuple[int | str, ...] | None:
    """Declared shape of a record's field: numbers and letters ("K+1" for a sum); None if it is no array."""
    shape = field.metadata.get("shape")
    if shape is None:
        return None
    return tuple(letter + (f"{n:+d}" if n else "") if letter else n for letter, n in shape)


def value_text(value: object) -> str:
    """A number, text or collection as Python writes it, cut short; of anything else its type. One line."""
    known = isinstance(value, str | int | float | list | tuple | dict)
    try:
        return " ".join(repr(value).split())[:160] if known else f"a {type(value).__name__}"
    except Exception:  # an integer of thousands of digits, or what a collection holds
        return f"a {type(value).__name__} too long to be shown"


def check_numbers(record: Any, *, any_value: tuple[str, ...] = (), zero: tuple[str, ...] = ()) -> None:
    """`ValueError` unless each field of a record that is declared as a number is one, finite and positive.

    Fields of `zero` may also be 0, those of `any_value` any number, infinite and NaN too; one declared as
    `... | None` may be None. Probabilities, shares and modulations are at most 1; pairs are finite.
    """
    cls: Any = type(record)
    for name, (kind, is_pair, may_be_none, part) in _numbers_of(cls).items():
        value, said = cast(Any, getattr(record, name)), f"{cls.__name__}.{name}"
        if value is None and may_be_none:
            continue
        if is_pair:
            is_two = isinstance(value, tuple | list) or getattr(value, "shape", ()) == (2,)
            if [_is_finite(one) for one in (value if is_two else ())] != [True, True]:
                raise ValueError(f"{said} must be two finite numbers, got {value_text(value)}")
            continue
        is_number = type(value) is kind or (isinstance(value, _NUMBERS[kind]) and not isinstance(value, bool))
        if not is_number:
            whole = "whole " if kind is int else ""
            raise ValueError(f"{said} must be a {whole}number, got {value_text(value)}")
        if name in any_value and not (isinstance(value, int) and abs(value) > LARGEST_NUMBER):
            continue
        far = value > 1 if part else not abs(value) < LARGEST_NUMBER
        if far or not value >= 0 or (value == 0 and name not in zero):
            expected = "zero or positive" if name in zero else "positive"
            limit = "at most 1" if part else "finite"
            raise ValueError(f"{said} must be {expected} and {limit}, got {value}")


_NUMBERS: dict[type, Any] = {float: numbers.Real, int: numbers.Integral}


@cache
def _numbers_of(cls: type) -> dict[str, tuple[type, bool, bool, bool]]:
    """Fields declared as numbers or pairs: the type, whether a pair, may be None, is a part of 1."""
    kinds = {field.name: str(field.type) for field in dataclasses.fields(cast(Any, cls))}
    return {
        name: (
            int if kind.startswith("int") else float,
            kind.startswith("tuple"),
            kind.endswith("None"),
            any(word in name for word in ("probability", "share_", "mtf_")),
        )
        for name, kind in kinds.items()
        if kind.split(" |")[0] in ("float", "int", "tuple[float, float]")
    }


def _is_finite(value: Any) -> bool:
    return isinstance(value, numbers.Real) and bool(abs(cast(Any, value)) < LARGEST_NUMBER)


def _row_fields(record: Any) -> list[str]:
    """Names of the fields that have rows."""
    held = {field.name: getattr(record, field.name) for field in dataclasses.fields(record) if field.init}
    arrays = {field.name for field in dataclasses.fields(record) if shape_of(field)}
    return [n for n, v in held.items() if isinstance(v, RowRecord) or (n in arrays and v is not None)]


def _dimension(text: str) -> Dimension:
    if not (match := _DIMENSION.fullmatch(text)):
        raise TypeError(f"a dimension is a number, a capital letter or such a letter + number, got {text!r}")
    number, letter, sign, offset = match.groups()
    return ("", int(number)) if number else (letter, int(f"{sign or '+'}{offset or 0}"))


def _post_init(
    name: str, checked: tuple[tuple[str, tuple[Dimension, ...], bool], ...], own: Callable[[Any], None] | None
) -> Callable[[Any], None]:
    def __post_init__(self: Any) -> None:
        lengths = {"": 0}
        fixed = lengths.setdefault
        for field, shape, optional in checked:
            value = getattr(self, field)
            if value is None and optional:
                continue
            found = value.shape if hasattr(value, "dtype") else _lengths(value)
            fits = len(found) == len(shape)
            for n, (letter, number) in zip(found, shape):
                # the first field that uses a letter sets that letter's length
                fits = fits and fixed(letter, n - number) == n - number
            if not fits:
                expected = ", ".join(_shown(dimension, lengths) for dimension in shape) + "," * (
                    len(shape) == 1
                )
                raise ValueError(f"{name}.{field} must have shape ({expected}), got {found}")
        if own is not None:
            own(self)

    return __post_init__


def _lengths(value: Any) -> tuple[int, ...]:
    """(n,) of a tuple or of n rotations, () of one rotation and of anything without a length."""
    try:
        return (len(value),)
    except Exception:  # of a class that has no length, or breaks when it is asked for
        return ()


def _shown(dimension: Dimension, lengths: dict[str, int]) -> str:
    letter, number = dimension
    return str(lengths[letter] + number) if letter in lengths else letter


def _documented(cls: type) -> str:
    """The class's docstring with a NumPy "Attributes" section made from its fields."""
    lines = list[str]()
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        if field.name.startswith("_"):
            continue
        kind = field.type if isinstance(field.type, str) else getattr(field.type, "__name__", str(field.type))
        shape = field.metadata.get("shape_text", "")
        lines.append(f"{field.name} : {f'{shape} ' if shape else ''}{kind}")
        lines.append(f"    {field.metadata.get('meaning', '')}".rstrip())
    for name, member in vars(cls).items():
        if isinstance(member, inner):
            lines += [name, f"    {member.__doc__}"]
    heading = ["", "Attributes", "----------"] if lines else []
    return "\n".join([inspect.cleandoc(cls.__doc__ or ""), *heading, *lines]) + "\n"
