"""Dumps in an object store (a local server of moto) and on web servers: the bytes of those on disk."""

import functools
import http.server
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from command_line import ran
from fixture_strips import begun
from rasters import write_raster
from stored import bucket_served

from boresight.pipeline.errors import RawDataError, WorkerError
from boresight.pipeline.files import object_store
from boresight.pipeline.files.content import content_digest
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.images.tiff import StripFiles
from boresight.pipeline.files.object_store import dump_folder, gdal_name
from boresight.pipeline.files.text_files import path_inside
from boresight.pipeline.results.ownership import claimed
from boresight.pipeline.run.settings import Settings


@pytest.fixture(scope="module")
def store(finished: tuple[Path, Path]) -> Iterator[str]:
    """Address of a server of objects that holds the dump of `finished` as s3://archive/passes/dump."""
    with bucket_served() as (address, files):
        files.put(f"{finished[0]}/", "archive/passes/dump/", recursive=True)
        files.s3_additional_kwargs = {"ACL": "private"}
        files.pipe("archive/private/dump.toml", b"")
        yield address


def assert_calibrated_alike(finished: tuple[Path, Path], out: Path, *how: str) -> None:
    """Carry a run over the stored dump, stopped after 13 of its 14 exposures, to the end of `finished`."""
    begun(out, finished, exposures=13)
    ran("calibrate", "s3://archive/passes/dump", "--out", out, "--no-report", *how)
    assert (out / "installation.json").read_bytes() == (finished[1] / "installation.json").read_bytes()
    units = {path.name for path in (out / "work").rglob("*.parquet")}
    assert units == {path.name for path in (finished[1] / "work").rglob("*.parquet")}  # keys of content


def test_dump_in_a_store_gives_the_bytes_of_the_one_on_disk(store, finished, tmp_path):
    assert_calibrated_alike(finished, tmp_path / "result", "--workers", "2")


def test_workers_of_a_cluster_read_a_dump_in_a_store(store, finished, tmp_path):
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0") as cluster:
        assert_calibrated_alike(finished, tmp_path / "result", "--scheduler", str(cluster.scheduler_address))


def test_dump_on_a_web_server_is_the_one_on_disk(store: str, finished: tuple[Path, Path]) -> None:
    there, here = open_dump(f"{store}/archive/passes/dump"), open_dump(finished[0])
    assert len(there.exposures) == len(here.exposures) > 0 and not there.omissions
    for a, b in zip(there.exposures, here.exposures):
        assert content_digest(a.path) == content_digest(b.path)
    assert str(there.exposures[0].path) == f"{store}/archive/passes/dump/{here.exposures[0].file}"


def test_window_of_a_large_image_is_fetched_alone(tmp_path, monkeypatch, recwarn):
    import fsspec

    image = np.random.default_rng(3).integers(0, 256, (3000, 4000), dtype=np.uint8)
    tiles = {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "lzw"}
    write_raster(tmp_path / "strip.tif", image, **tiles)
    content = (tmp_path / "strip.tif").read_bytes()
    fsspec.filesystem("memory").pipe("/large/strip.tif", content)
    path = dump_folder("memory://large") / "strip.tif"
    fetched = []
    real = object_store._range

    def counted(address: str, start: int, end: int) -> bytes:
        fetched.append(end - start)
        return real(address, start, end)

    monkeypatch.setattr(object_store, "_range", counted)
    strip = StripFiles({0: path}, {0: "strip.tif"}, {0: image.shape})
    for _ in range(2):  # the second time from kept blocks
        np.testing.assert_array_equal(strip.read(0, 1000, 1100, 500, 700), image[1000:1100, 500:700])
        assert sum(fetched) < len(content) / 4
    assert content_digest(path) == content_digest(tmp_path / "strip.tif")

    def silent(address: str, start: int, end: int) -> bytes:
        raise WorkerError("no answer")

    monkeypatch.setattr(object_store, "_range", silent)
    with pytest.raises(WorkerError, match="no answer"):  # no damaged image, which would be left out
        strip.read(0, 2000, 2100, 500, 700)


def test_new_version_of_an_object_has_another_digest(monkeypatch: pytest.MonkeyPatch) -> None:
    import fsspec

    monkeypatch.setattr(object_store, "CURRENT_S", 1e-9)
    files, path = fsspec.filesystem("memory"), dump_folder("memory://versions") / "a.toml"
    files.pipe("/versions/a.toml", b"one")
    first = content_digest(path)
    files.pipe("/versions/a.toml", b"two")  # of the same size
    assert content_digest(path) != first


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("s3://archive/nothing", "s3://archive/nothing: dump: found no such folder"),
        ("s3://no-such-bucket/dump", "The specified bucket does not exist"),
        ("http://127.0.0.1:9/dump", "Cannot connect to host 127.0.0.1:9"),
        ("{store}/archive/private", "403, message='FORBIDDEN'"),
        ("https://me:secret@host/dump", "host/dump: address: found @ in it"),
        ("nosuch://host/dump", "Protocol not known: nosuch"),
    ],
)
def test_address_without_a_dump_is_an_error_that_names_why(store: str, address: str, said: str) -> None:
    with pytest.raises((OSError, RawDataError, WorkerError)) as error:
        open_dump(address.format(store=store))
    assert said in str(error.value) and ":secret" not in str(error.value)


def test_store_without_credentials_is_an_error_that_says_so(store, monkeypatch):
    import fsspec

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", os.devnull)
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    with pytest.raises(WorkerError, match="Unable to locate credentials"):
        open_dump("s3://archive/other")
    fsspec.get_filesystem_class("s3").clear_instance_cache()


def test_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    with pytest.raises(WorkerError, match=r"pip install 'boresight\[cluster\]'"):
        open_dump("gcs://archive/dump")


def test_server_without_ranges_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "large.tif").write_bytes(bytes(2 * object_store.BLOCK_BYTES))
    silent = type("Silent", (http.server.SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    handler = functools.partial(silent, directory=tmp_path)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        path = dump_folder(f"http://127.0.0.1:{server.server_port}") / "large.tif"
        assert len(path.read_bytes()) == path.stat().st_size == 2 * object_store.BLOCK_BYTES
        with path.open("rb") as stream, pytest.raises(WorkerError, match="does not serve ranges"):
            stream.read(10)
        server.shutdown()


class Hostile(http.server.BaseHTTPRequestHandler):
    """States 1000 bytes and sends without end, in chunks; of `stalls` nothing, though a size was stated."""

    sent = 0

    def do_HEAD(self) -> None:
        self.send_response(200)
        self.send_header("Content-Length", "1000")
        self.end_headers()

    def do_GET(self) -> None:
        if "stalls" in self.path:
            threading.Event().wait(1.0)  # twice the limit of the test
            return
        self.send_response(206)
        self.send_header("Content-Range", "bytes 0-999/1000")
        self.send_header("Connection", "close")
        self.end_headers()
        with suppress(OSError):
            for _ in range(10_000):  # 10 GB
                self.wfile.write(bytes(1_000_000))
                Hostile.sent += 1_000_000

    def log_message(self, *_: object) -> None:
        pass


def test_server_that_stalls_or_sends_without_end_is_named_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_store, "ANSWER_S", 0.5)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Hostile) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        root = dump_folder(f"http://127.0.0.1:{server.server_port}")
        begun_s = time.monotonic()
        with pytest.raises(WorkerError, match=rf"{root}/stalls: no answer within 0.51 s; .* to a disk"):
            (root / "stalls").read_bytes()
        with pytest.raises(WorkerError, match=rf"{root}/endless: more than 1000 bytes of a range of 1000"):
            (root / "endless").read_bytes()
        assert Hostile.sent < 100_000_000 and time.monotonic() - begun_s < 30.0  # buffers of the system
        monkeypatch.setattr(object_store, "MOST_BYTES", 999)
        with pytest.raises(OSError, match="1000 bytes, at most 999 are fetched"):
            (root / "large").read_bytes()
        server.shutdown()


def test_stored_dump_cannot_be_left_or_written(tmp_path: Path) -> None:
    root = dump_folder("s3://archive/passes/dump")
    assert path_inside(root, "a/b.tif", file="dump.toml", field="f") == root / "a" / "b.tif"
    for outside in ("../other", "/etc/passwd", "s3://other/x"):
        with pytest.raises(RawDataError, match="inside the dump"):
            path_inside(root, outside, file="dump.toml", field="f")
    with pytest.raises(OSError, match="only read"):
        (root / "dump.toml").write_text("x")
    assert gdal_name(root / "a.tif") == "/vsis3/archive/passes/dump/a.tif"
    assert gdal_name(tmp_path / "a.tif") == str(tmp_path / "a.tif")


def test_result_cannot_be_written_into_a_store(finished: tuple[Path, Path]) -> None:
    with (
        pytest.raises(RawDataError, match="--out: s3:"),
        claimed(Path("s3://a/b"), [finished[0]], Settings()),
    ):
        pass
