"""A unit is found again by everything that it was made from, and by nothing else."""

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import pytest
from scipy.spatial.transform import Rotation

from boresight.pipeline.calibration_run import RunRequest, run_dump
from boresight.pipeline.files import content
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.table_files import fixed_list, list_values
from boresight.pipeline.run import digests, program_key
from boresight.pipeline.run.digests import digest
from boresight.pipeline.run.executor import InOrder, Processes
from boresight.pipeline.run.program_key import program_digest
from boresight.pipeline.run.run_inputs import inputs_of
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.run.unit_store import UnitStore, read_meta
from boresight.pipeline.stages.exposure import sight_exposure
from boresight.pipeline.stages.strip import match_strip_targets

ROOT = Path(__file__).parents[3]
GEOMETRY, STARS, MATCH = "boresight.geometry", "boresight.star_id", "boresight.gct_match"


@dataclass(frozen=True)
class Task:
    name: str
    values: np.ndarray
    turn: Rotation
    file: Path
    settings: dict


def task(tmp_path: Path, **changes: object) -> Task:
    (tmp_path / "image").write_bytes(b"pixels")
    parts = {"name": "e1", "values": np.arange(3.0), "turn": Rotation.from_rotvec([0.1, 0.2, 0.3])}
    return Task(**parts | {"file": tmp_path / "image", "settings": {"a": 1, "b": 2.5}} | changes)


def test_digest_changes_with_every_part_and_only_then(tmp_path: Path) -> None:
    (tmp_path / "copy").write_bytes(b"pixels")
    (tmp_path / "other").write_bytes(b"pixelz")
    same = [{}, {}, {"file": tmp_path / "copy"}, {"settings": {"b": 2.5, "a": 1}}]
    others = [
        {"name": "e2"},
        {"values": np.nextafter(np.arange(3.0), 9.0)},
        {"values": np.arange(3.0).reshape(3, 1)},
        {"values": np.arange(3.0, dtype=np.float32)},
        {"turn": Rotation.from_rotvec([0.1, 0.2, 0.3 + 1e-15])},
        *({"file": tmp_path / name} for name in ("other", "missing")),
        {"settings": {"a": 1, "b": 2.5000000000000004}},
    ]
    assert len({digest(task(tmp_path, **one)) for one in same}) == 1
    assert len({digest(task(tmp_path, **one)) for one in [*same, *others]}) == 1 + len(others)


def test_what_has_no_digest_is_refused() -> None:
    with pytest.raises(TypeError, match="no digest for a set"):
        digest({1, 2})


def test_program_follows_imports_and_knows_data_folders_and_libraries(tmp_path, monkeypatch):
    root = tmp_path / "made_package"
    for folder in ("data", "inner"):
        (root / folder).mkdir(parents=True)
    (root / "inner" / "__init__.py").touch()
    (root / "inner" / "module.py").touch()
    for name, text in {
        "__init__": "",
        "stage": "from made_package import reader\ndef f():\n    from made_package.late import g",
        "reader": "A = 1",
        "late": "from made_package.deeper import (\n    h,\n)",
        "deeper": "from made_package.inner.module import h",
        "other": "B = 1",
    }.items():
        (root / f"{name}.py").write_text(text + "\n")
    (root / "data" / "table.bin").write_bytes(b"1")
    monkeypatch.syspath_prepend(tmp_path)

    def key(of: str = "made_package.stage") -> str:
        program_digest.cache_clear()
        digests._module.cache_clear()
        return program_digest(of)

    keys = [key()]
    modules = ("__init__.py", "stage.py", "reader.py", "late.py", "deeper.py", "inner/__init__.py")
    for file in (*modules, "data/table.bin"):
        (root / file).write_text((root / file).read_text() + "# changed\n")
        keys.append(key())
    assert len(set(keys)) == 8
    (root / "other.py").write_text("B = 2\n")
    assert key() == keys[-1]
    whole = key("made_package")
    (root / "inner" / "module.py").write_text("A = 2\n")
    assert key("made_package") != whole
    versions = program_key.library_versions()
    assert {"python", "numpy", "scipy", "opencv", "rasterio", "gdal", "astropy", "pyerfa"} <= set(versions)
    for name in versions:
        changed = versions | {name: "0"}
        monkeypatch.setattr(program_key, "library_versions", lambda changed=changed: changed)
        keys.append(key())
    assert len(set(keys)) == 8 + len(versions)
    program_digest.cache_clear()
    digests._module.cache_clear()


def test_program_of_a_stage_includes_the_readers_of_files() -> None:
    for stage in (sight_exposure, match_strip_targets):
        modules = set(digests.sources_of(stage.__module__))
        assert {
            "boresight.pipeline.files.images.tiff",
            "boresight.pipeline.files.strip_table",
            "boresight.geometry.orbit",
            "data of boresight.geometry",
        } <= modules
    assert "boresight.star_id.sight" in digests.sources_of(sight_exposure.__module__)
    assert "boresight.gct_match.match" in digests.sources_of(match_strip_targets.__module__)


def test_digest_reads_all_bytes_of_a_large_file_and_nothing_else(tmp_path: Path) -> None:
    """10 MiB changed amid 100 MiB with times kept: another digest; a copy with other times: the same."""
    path, copy = tmp_path / "large", tmp_path / "copy"
    with path.open("wb") as stream:
        stream.truncate(100 * 2**20)
    times = (path.stat().st_atime_ns, path.stat().st_mtime_ns)
    before = digest(path)
    shutil.copyfile(path, copy)
    os.utime(copy, ns=(1, 1))
    assert digest(copy) == before
    with path.open("r+b") as stream:
        stream.seek(45 * 2**20)
        stream.write(b"x" * 10 * 2**20)
    os.utime(path, ns=times)
    assert digest(path) != before


def test_what_is_no_regular_file_has_a_digest_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    assert digest(tmp_path / "fifo") != digest(tmp_path / "missing") != digest(Path("/dev/zero"))


def test_unit_is_read_back_bit_for_bit_and_replaces_its_predecessor(tmp_path: Path) -> None:
    store, values = UnitStore(tmp_path), np.random.default_rng(2).normal(size=(4, 3, 3))
    table = pa.table({"cov": fixed_list(values)})
    store.write("stage", "s.1", "old", table, {"id": "s.1", "t_s": 0.1 + 0.2})
    store.write("stage", "s.1.x", "old", table, {"id": "s.1.x"})
    store.write("stage", "s.1", "new", table, {"id": "s.1", "t_s": 0.1 + 0.2})
    assert store.read("stage", "s.1", "old") is None
    assert store.read("stage", "s.1.x", "old") is not None
    back = store.read("stage", "s.1", "new")
    assert np.array_equal(list_values(back, "cov", 3, 3), values)
    assert read_meta(back) == {"id": "s.1", "t_s": 0.1 + 0.2}
    (tmp_path / "stage" / "s.1.new.parquet").write_bytes(b"PAR1 damaged")
    assert store.read("stage", "s.1", "new") is None


@pytest.mark.parametrize("executor, by_this_process", [(InOrder(), 1), (Processes(2), 0)])
def test_a_run_reads_each_exposure_once(one_strip, tmp_path, monkeypatch, executor, by_this_process):
    """For key, image and digest of the inputs; what other processes have read is not read once more."""
    dump, own = open_dump(one_strip), content.open_regular
    content._digests.clear()
    content._content.cache_clear()
    read: list[Path] = []

    def noted(path: Path, buffering: int = -1) -> BinaryIO:
        read.append(path)
        return own(path, buffering)

    monkeypatch.setattr(content, "open_regular", noted)
    request = RunRequest(settings=Settings(), begun_s=0.0, facts={}, report=False, executor=executor)
    run_dump(tmp_path / "result", dump, "one", request)
    exposures = [exposure.path for exposure in dump.exposures]
    assert [read.count(path) for path in exposures] == [by_this_process] * len(exposures)
    assert json.loads((tmp_path / "result" / "run.json").read_text())["inputs"] == digest_of(dump)


def digest_of(dump: Dump) -> str:
    """Digest of the inputs, of files that are read again."""
    content._digests.clear()
    return inputs_of([dump], Settings()).digest()


def test_inputs_have_no_digest_if_a_file_changes_during_the_run(one_strip: Path) -> None:
    """The result may be of the earlier content: the next run has to look at all units again."""
    dump = open_dump(one_strip)
    inputs = inputs_of([dump], Settings())
    assert len(inputs.digest()) > 30
    path = dump.exposures[3].path
    path.write_bytes(path.read_bytes() + b"x")
    assert inputs.digest() == ""
