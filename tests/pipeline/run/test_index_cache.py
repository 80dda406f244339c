"""An index kept on disk gives the answers of the one that was built, and its loss or damage costs time."""

import sys
import warnings
from dataclasses import fields

import numpy as np
import pytest

from boresight.pipeline.run import index_cache
from boresight.pipeline.run.index_cache import cache_folder, cached_index, write_arrays
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.identification.triangle_index import StarIndex, TriangleTable, build_index

FOV = 0.6  # rad: a small index


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "boresight"


@pytest.fixture(scope="module")
def places():
    return hipparcos_stars(6.0).places


@pytest.fixture
def builds(monkeypatch):
    """Counts how often an index is built."""
    count = []

    def counted(*arguments):
        count.append(arguments)
        return build_index(*arguments)

    monkeypatch.setattr(index_cache, "build_index", counted)
    return count


def same(one: StarIndex, other: StarIndex) -> bool:
    return len(one.tables) == len(other.tables) and all(
        np.array_equal(getattr(a, field.name), getattr(b, field.name))
        for a, b in zip(one.tables, other.tables)
        for field in fields(TriangleTable)
    )


def test_a_kept_index_is_the_one_that_was_built(places, builds):
    built = build_index(places, 2020.0, (FOV, 2.0 * FOV))
    for _ in range(2):
        got = cached_index(places, 2020.0, (FOV, 2.0 * FOV))
        assert same(got, built) and np.array_equal(got.u_i, built.u_i)
        assert np.array_equal(got.stars.hip, built.stars.hip)
    assert len(builds) == 1


def test_another_catalogue_epoch_field_or_program_makes_another_index(places, builds, cache, monkeypatch):
    cached_index(places, 2020.0, FOV)
    cached_index(places.take(np.arange(len(places.hip) - 1)), 2020.0, FOV)
    cached_index(places, 2021.0, FOV)
    cached_index(places, 2020.0, 1.01 * FOV)
    monkeypatch.setattr(index_cache, "numerical_program", lambda package: f"another {package}")
    cached_index(places, 2020.0, FOV)
    assert len(builds) == 5 == len(list(cache.iterdir()))


@pytest.mark.parametrize("damage", ["cut", "flipped", "emptied", "not an archive", "pickled", "other arrays"])
def test_a_damaged_file_is_made_anew_with_a_warning(places, builds, cache, damage):
    built = cached_index(places, 2020.0, FOV)
    (file,) = cache.iterdir()
    content, half = file.read_bytes(), file.stat().st_size // 2
    flipped = content[:half] + bytes([content[half] ^ 0xFF]) + content[half + 1 :]
    others = {"cut": content[:half], "flipped": flipped, "emptied": b"", "not an archive": b"triangles"}
    if damage in others:
        file.write_bytes(others[damage])
    elif damage == "pickled":
        with file.open("wb") as stream:
            np.savez(stream, **{"0.vertices": np.array([{}], dtype=object)})
    else:
        write_arrays(file, built.arrays | {"0.vertices": built.arrays["0.vertices"] + 10**6})
    with pytest.warns(UserWarning, match="built again"):
        again = cached_index(places, 2020.0, FOV)
    assert same(again, built) and len(builds) == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert same(cached_index(places, 2020.0, FOV), built)
    assert len(builds) == 2


def test_a_folder_that_cannot_be_made_costs_time_only(places, builds, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        first, second = cached_index(places, 2020.0, FOV), cached_index(places, 2020.0, FOV)
    assert same(first, second) and len(builds) == 2


def test_a_folder_that_cannot_be_written_costs_time_only(places, builds, cache, monkeypatch):
    def refused(path, write):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(index_cache, "write_whole", refused)  # root may write where others may not
    assert same(cached_index(places, 2020.0, FOV), cached_index(places, 2020.0, FOV))
    assert len(builds) == 2 and not list(cache.iterdir())


def test_only_a_few_files_are_kept_and_those_in_use_stay(places, cache):
    cached_index(places, 2020.0, FOV)
    (used,) = cache.iterdir()
    for k in range(8):
        cached_index(places, 2021.0 + k, FOV)
        cached_index(places, 2020.0, FOV)
    assert len(list(cache.iterdir())) == 6 and used.is_file()


@pytest.mark.skipif(sys.platform != "linux", reason="the folder below is that of Linux")
def test_the_folder_is_the_users_own(monkeypatch, tmp_path):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / ".cache" / "boresight"
