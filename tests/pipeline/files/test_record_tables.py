"""Records come back from tables bit for bit, in the types that they declare."""

from __future__ import annotations

import dataclasses
import json
from enum import StrEnum
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from boresight.geometry.sightings import GroundSightings, StarSightings
from boresight.pipeline.files.record_tables import (
    columns_of,
    record_from_columns,
    record_from_table,
    table_from_record,
)
from boresight.pipeline.files.table_files import arrow_array, arrow_rows, column
from boresight.pipeline.results.sightings_tables import COLUMNS
from boresight.records.record import Bools, Floats, Ints, Texts, array, record, scalar, shape_of


class Colour(StrEnum):
    RED = "red"


@record
class Note:
    text: str = scalar("a text")
    colour: Colour = scalar("an enum", default=Colour.RED)


@record
class Picture:
    png: bytes = scalar("a picture")
    low: float = scalar("a value")


@record(kw_only=True)
class Everything:
    names: Texts = array("N", "texts")
    flags: Bools = array("N", "flags")
    numbers: Ints = array("N", "whole numbers")
    matrices: Floats = array("N, 2, 3", "matrices")
    pictures: tuple[Picture, ...] = array("N", "records")
    t_s: float = scalar("a number")
    notes: tuple[Note, ...] = scalar("records")


def everything(n: int) -> Everything:
    rng = np.random.default_rng(3)
    matrices = rng.normal(size=(n, 2, 3))
    matrices[:1, 0, 0] = np.nan
    return Everything(
        names=np.array([f"t{k}µ" for k in range(n)], dtype=str),
        flags=rng.random(n) < 0.5,
        numbers=rng.integers(-(2**60), 2**60, n),
        matrices=matrices,
        pictures=tuple(Picture(bytes([k, 255]), 0.1 * k) for k in range(n)),
        t_s=0.1 + 1e-17,
        notes=(Note("cloud"), Note("edge")),
    )


@pytest.mark.parametrize("n", [0, 1, 5])
def test_record_comes_back_bit_for_bit_from_a_file(n: int, tmp_path: Path) -> None:
    given = everything(n)
    table, values = table_from_record(given)
    pq.write_table(table, tmp_path / "one.parquet")
    back = record_from_table(
        (Note, Everything), pq.read_table(tmp_path / "one.parquet"), json.loads(json.dumps(values))
    )
    for name in ("names", "flags", "numbers", "matrices"):
        a, b = getattr(given, name), getattr(back, name)
        assert a.shape == b.shape and a.dtype.kind == b.dtype.kind and a.tobytes() == b.tobytes(), name
    assert [(p.png, p.low) for p in back.pictures] == [(p.png, p.low) for p in given.pictures]
    assert back.t_s == given.t_s
    assert [(note.text, note.colour) for note in back.notes] == [("cloud", Colour.RED), ("edge", Colour.RED)]
    assert type(back.notes[0].colour) is Colour


def test_table_of_another_record_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="expected a table of StarSightings, found 'Note'"):
        record_from_table((StarSightings,), *table_from_record(Note("cloud")))


def test_values_of_the_whole_are_given_where_only_columns_are_kept() -> None:
    given = everything(3)
    back = record_from_columns(Everything, pa.table(columns_of(given)), t_s=7.0, notes=())
    assert (back.t_s, back.numbers.tolist()) == (7.0, given.numbers.tolist())


def empty(kind: type[Any], **others: object) -> Any:
    """A record of no rows."""
    shapes = {one.name: shape_of(one) for one in dataclasses.fields(kind)}
    text = get_type_hints(kind)
    return kind(
        **{
            name: np.zeros([0 if d == "N" else d for d in shape], str if text[name] is Texts else float)
            for name, shape in shapes.items()
            if shape
        },
        **others,
    )


def test_columns_of_sightings_are_those_of_the_format() -> None:
    # docs/result-format.md
    stars = empty(StarSightings, exposure_id="e1", t_s=0.0)
    assert list(columns_of(stars)) == ["hip", "xy_px", "u_s", "u_i", "cov_s", "snr"]
    expected = "target_id ccd xy_px t_s u_c u_i cov_c range_m v_rel_i cov_target_i"
    of_targets = list(columns_of(empty(GroundSightings)))
    from_states = ["earth_i", "light_i"]  # are not written: date, orbit and settings give them
    assert of_targets == [*expected.split(), *from_states]
    assert not {*from_states} & {*COLUMNS["targets"]}


@pytest.mark.parametrize(
    "values, kind",
    [
        ([1.5, None, float("nan"), -0.0], pa.float64()),
        (np.arange(9) - 4, pa.int64()),
        ([True, False, None] * 5, pa.bool_()),
        (["", "Ω", None, "a" * 300], pa.string()),
        ([b"\x00", None, b""], pa.binary()),
        ([[1.0, 2.0], None, (3.0, 4.0)], pa.list_(pa.float64(), 2)),
        ([], pa.string()),
    ],
)
def test_an_array_made_of_buffers_is_that_of_arrow(values, kind):
    made = arrow_array(values, kind)
    made.validate(full=True)
    assert str(made) == str(pa.array(values, kind)) and made.type == kind
    rows, schema = [{"a": value} for value in values], pa.schema([("a", kind)])
    assert str(arrow_rows(rows, schema)) == str(pa.Table.from_pylist(rows, schema))


def test_columns_come_back_with_empty_cells_as_nan_or_none():
    table = pa.table({"a": pa.array([1.0, None]), "b": pa.array(["x", None]), "c": pa.array([True, False])})
    assert np.array_equal(column(table, "a"), [1.0, np.nan], equal_nan=True)
    assert column(table, "b").tolist() == ["x", None] and column(table, "c").tolist() == [True, False]
