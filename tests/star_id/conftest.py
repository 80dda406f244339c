"""What several modules ask of real frames: each is solved once in a run of all tests."""

import pickle

import pytest
from known_frames import real, wide_index

from boresight.star_id.field import solve_field
from boresight.star_id.settings import StarSettings


@pytest.fixture(scope="session")  # processes come back to these modules after others
def wide(made_once):
    """Index of the shipped catalogue for every field of view."""
    folder = made_once("wide-index", lambda at: (at / "index").write_bytes(pickle.dumps(wide_index())))
    return pickle.loads((folder / "index").read_bytes())


@pytest.fixture(scope="session")
def solution(made_once, wide):
    """What a real frame shows by itself, nothing known of its camera."""

    def solved(row):
        def fill(folder):
            (folder / "solved").write_bytes(pickle.dumps(solve_field(real(row), wide, StarSettings())))

        return pickle.loads((made_once(f"real-{row['sha1']}", fill) / "solved").read_bytes())

    return solved
