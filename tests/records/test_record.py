"""Records: one declaration gives the shape check, the documentation and keyword construction."""

from __future__ import annotations

import dataclasses
import pydoc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.records.record import Floats, RowRecord, array, inner, record, scalar, shape_of


@record
class Points:
    """Places in an image. Row n of every array is the same place."""

    xy_px: Floats = array("N, 2", "centroids as (column, row)")
    cov_px: Floats = array("N, 2, 2", "covariances, px²")
    edges: Floats = array("N + 1", "boundaries between the places")
    R_ab: Rotation = array("N", "rotations, b to a")
    limit: float = scalar("largest distance, px", default=2.0)

    def __post_init__(self) -> None:
        if self.limit < 0.0:
            raise ValueError(f"limit must not be negative, got {self.limit}")


def points(n: int, **changes: object) -> Points:
    parts = {
        "xy_px": np.zeros((n, 2)),
        "cov_px": np.zeros((n, 2, 2)),
        "edges": np.zeros(n + 1),
        "R_ab": Rotation.identity(n),
    }
    return Points(**(parts | changes))


@pytest.mark.parametrize("n", [0, 1, 7])
def test_record_of_matching_shapes_is_accepted(n: int) -> None:
    assert points(n).limit == 2.0


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("cov_px", np.zeros((4, 2, 2)), r"Points.cov_px must have shape \(3, 2, 2\), got \(4, 2, 2\)"),
        ("cov_px", np.zeros((3, 2)), r"Points.cov_px must have shape \(3, 2, 2\), got \(3, 2\)"),
        ("xy_px", np.zeros((3, 3)), r"Points.xy_px must have shape \(3, 2\), got \(3, 3\)"),
        ("edges", np.zeros(3), r"Points.edges must have shape \(4,\), got \(3,\)"),
        ("R_ab", Rotation.identity(), r"Points.R_ab must have shape \(3,\), got \(\)"),
    ],
)
def test_record_refuses_an_array_of_another_shape(field: str, value: object, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        points(3, **{field: value})


def test_own_check_of_a_record_runs_after_that_of_its_shapes() -> None:
    with pytest.raises(ValueError, match="limit must not be negative, got -1"):
        points(3, limit=-1.0)


def test_help_shows_shape_type_and_meaning_of_every_field() -> None:
    text = pydoc.plain(pydoc.render_doc(Points))
    for line in (
        "xy_px : (N, 2) Floats",
        "    centroids as (column, row)",
        "limit : float",
        "largest distance, px",
    ):
        assert line in text


def test_a_record_is_frozen_and_replaced_with_its_check() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        points(2).limit = 1.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="xy_px"):
        dataclasses.replace(points(2), xy_px=np.zeros((2, 3)))


def test_an_inner_attribute_is_that_of_the_record_held_and_help_shows_its_meaning() -> None:
    @record
    class Held:
        """Held."""

        snr: Floats = array("N", "signal over noise")

    @record
    class Holder:
        """Holder."""

        held: Held = scalar("the full record")
        snr = inner[Floats]("held.snr", "(N,) signal over noise")

    holder = Holder(Held(np.array([3.0, 5.0])))
    assert holder.snr is holder.held.snr
    assert "snr\n    (N,) signal over noise\n" in (Holder.__doc__ or "")
    assert "(N,) signal over noise" in pydoc.render_doc(Holder.snr)


def test_declared_shape_can_be_read_back() -> None:
    by_name = {f.name: shape_of(f) for f in dataclasses.fields(Points)}
    shapes = {"xy_px": ("N", 2), "cov_px": ("N", 2, 2), "edges": ("N+1",), "R_ab": ("N",), "limit": None}
    assert by_name == shapes


def test_misspelt_shape_is_refused_where_it_is_declared() -> None:
    with pytest.raises(TypeError, match="'n'"):
        array("n, 2", "lower case")


@record
class Places(RowRecord):
    """Row n of every array, and of the record held, is the same place."""

    R_ab: Rotation = array("N", "rotations, b to a")
    height_m: Floats | None = array("N", "heights; None: not known", default=None)
    inside: Places | None = scalar("more of the same places", default=None)
    limit: float = scalar("largest distance, px", default=2.0)


def places(first: int, n: int) -> Places:
    turns = Rotation.from_rotvec(np.outer(np.arange(first, first + n), [0.0, 0.0, 0.1]))
    return Places(turns, inside=Places(turns, np.arange(first, first + n, dtype=float)), limit=float(first))


def test_rows_are_chosen_and_joined_in_all_arrays_and_in_records_held():
    whole = Places.together([places(0, 0), places(0, 3), places(3, 2)])
    assert len(whole.R_ab) == 5 and whole.height_m is None and whole.limit == 0.0
    assert whole.inside is not None and whole.inside.height_m.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    for rows in (np.array([4, 1]), np.array([False, True, False, False, True])):
        chosen = whole.take(rows)
        assert chosen.inside is not None and sorted(chosen.inside.height_m.tolist()) == [1.0, 4.0]
        # rad: rounding of rotations by up to 0.4 rad
        assert chosen.R_ab.as_rotvec()[:, 2] == pytest.approx(0.1 * chosen.inside.height_m, abs=1e-15)
