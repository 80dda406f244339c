"""What is sent between processes arrives as it is pickled elsewhere, however large its arrays are."""

from __future__ import annotations

import multiprocessing
import os
import sys
from threading import Thread
from typing import Any

import numpy as np
import pytest

from boresight.pipeline.work.transfer import SMALL_BYTES, Parcel, receive, send

PIXELS = np.arange(3 * SMALL_BYTES, dtype=np.uint8).reshape(384, -1)
SENT = {
    "in rows": PIXELS,
    "in columns": np.asfortranarray(PIXELS.astype(np.float64)),
    "every second": PIXELS[::2, ::2],
    "of an odd size": PIXELS.ravel()[: SMALL_BYTES + 3],
    "none": np.zeros((0, 5)),
    "few": np.arange(7.0),
    "words": [{"one": 1}, "two"],
}
in_memory = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="the system has no files in memory")


def passed(sent: Any) -> tuple[Any, Parcel]:
    """An object that has gone through a pipe, and the parcel that it arrived in."""
    here, there = multiprocessing.Pipe()
    with here, there:
        sender = Thread(target=send, args=(there, sent))  # a pipe takes little before it is read
        sender.start()
        parcel = receive(here)
        sender.join()
    return parcel.unpacked(), parcel


def same(found: dict[str, Any], sent: dict[str, Any]) -> bool:
    return found.keys() == sent.keys() and all(
        found[name].dtype == one.dtype
        and found[name].flags.writeable == one.flags.writeable
        and np.array_equal(found[name], one)
        if isinstance(one, np.ndarray)
        else found[name] == one
        for name, one in sent.items()
    )


@in_memory
def test_large_arrays_go_through_shared_memory_and_everything_else_through_the_pipe() -> None:
    fixed = PIXELS.copy()
    fixed.flags.writeable = False
    sent = SENT | {"fixed": fixed}
    found, parcel = passed(sent)
    assert same(found, sent)
    large = sorted(one.nbytes for one in sent.values() if getattr(one, "nbytes", 0) >= SMALL_BYTES)
    assert sorted(array.nbytes for array in parcel.arrays) == [n for n in large if n != PIXELS.nbytes // 4]
    assert len(parcel.content) < 2 * SMALL_BYTES  # the array of every second pixel is in no one piece


def no_memory(name: str) -> int:
    raise OSError("none left")


@pytest.mark.parametrize("there_is_none", [True, False])
def test_without_files_in_memory_all_goes_through_the_pipe(
    there_is_none: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if there_is_none:
        monkeypatch.delattr(os, "memfd_create", raising=False)
    else:
        monkeypatch.setattr(os, "memfd_create", no_memory, raising=False)
    found, parcel = passed(SENT)
    assert parcel.arrays == () and same(found, SENT)


@pytest.mark.skipif(sys.platform != "linux", reason="counts open files as Linux lists them")
def test_no_file_stays_open() -> None:
    passed(SENT)
    before = sorted(os.listdir("/proc/self/fd"))
    kept = [passed(SENT) for _ in range(3)]
    assert sorted(os.listdir("/proc/self/fd")) == before, len(kept)


def test_an_end_that_has_closed_is_noticed() -> None:
    here, there = multiprocessing.Pipe()
    there.close()
    with here, pytest.raises((EOFError, ConnectionError)):
        receive(here)
