"""Every reader given damaged files: something is read, or a documented error says what is wrong. A short run
of what `benchmarks/fuzz_readers.py` does at length.
"""

import random
import warnings
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from readers import DOCUMENTED, READERS, Reader, mutated, write_sound_files

from boresight.pipeline.errors import RawDataError


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sound_files(tmp_path_factory.mktemp("sound"))


MAY_BE_EMPTY = ("settings", "scenario", "plan", "plan, forecast", "status")  # defaults, or nothing finished
QUICK = [reader for reader in READERS if reader.name != "plan, forecast"]


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_sound_file_is_read_and_an_empty_one_refused(reader: Reader, root: Path) -> None:
    path = root / reader.file
    sound = path.read_bytes()
    assert reader.read(root) is not None
    path.write_bytes(b"")
    try:
        refused = reader.read(root) is None  # a damaged unit is none
    except DOCUMENTED:
        refused = True
    finally:
        path.write_bytes(sound)
    assert refused == (reader.name not in MAY_BE_EMPTY)


@pytest.mark.parametrize("reader", QUICK, ids=lambda reader: reader.name)
def test_damaged_file_is_read_or_refused(reader: Reader, root: Path) -> None:
    path = root / reader.file
    sound = path.read_bytes()

    @settings(max_examples=25, derandomize=True, deadline=None, database=None)
    @given(st.integers(0, 2**32))
    def tried(number: int) -> None:
        path.write_bytes(mutated(random.Random(number), sound, reader.is_text))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                reader.read(root)
        except DOCUMENTED as error:
            assert 0 < len(str(error)) < 1000
            if isinstance(error, RawDataError):
                assert all((error.file, error.field, error.found is not None, error.expected))
                assert "\n" not in str(error)

    try:
        tried()
    finally:
        path.write_bytes(sound)
