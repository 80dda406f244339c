"""What several modules ask of real frames: each is solved once in a run of all tests."""

import pickle

import numpy as np
import pytest
from frames import PLACES
from known_frames import index_of_all_fields, real

from boresight.star_id.field import solve_field
from boresight.star_id.identification.triangle_index import build_index
from boresight.star_id.settings import StarSettings


@pytest.fixture(scope="session")  # processes come back to these modules after others
def index_of(made_once):
    """Index of the shipped catalogue for every field of view, at an epoch."""

    def of(year):
        fill = lambda at: (at / "index").write_bytes(pickle.dumps(index_of_all_fields(year)))  # noqa: E731
        return pickle.loads((made_once(f"wide-index-{year}", fill) / "index").read_bytes())

    return of


@pytest.fixture(scope="module")
def index():
    """Of fields of 15 to 24 degrees, at the epoch of the places."""
    return build_index(PLACES, PLACES.epoch_jyear, (np.radians(15.0), np.radians(24.0)))


@pytest.fixture(scope="session")
def wide(index_of):
    """At the epoch of real frames."""
    return index_of(2019.0)


@pytest.fixture(scope="session")
def wide_index(index_of):
    """At the epoch of the places."""
    return index_of(PLACES.epoch_jyear)


@pytest.fixture(scope="session")
def solution(made_once, wide):
    """What a real frame shows by itself, nothing known of its camera."""

    def solved(row):
        def fill(folder):
            (folder / "solved").write_bytes(pickle.dumps(solve_field(real(row), wide, StarSettings())))

        return pickle.loads((made_once(f"real-{row['sha1']}", fill) / "solved").read_bytes())

    return solved
