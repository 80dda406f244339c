"""A calibration into an existing result computes again what has changed, and only that."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.results.folder import store_of
from boresight.pipeline.run import digests, program_key
from boresight.pipeline.run.settings import settings_from_tables

EXPOSURES, STRIPS = 14, 1  # units of the one-strip dump; the strip is settled by one matching


@pytest.fixture
def copied(finished: tuple[Path, Path], tmp_path: Path) -> tuple[Path, Path]:
    """A finished dump and its units, copied so that a test may change them."""
    dump, result = finished
    shutil.copytree(dump, tmp_path / "dump")
    shutil.copytree(result / "work", tmp_path / "result" / "work")
    return tmp_path / "dump", tmp_path / "result"


def units_made(dump: Path, result: Path, settings: dict | None = None) -> int:
    chosen = settings_from_tables(settings or {}, "settings.toml")
    found = calibrate_dump(open_dump(dump), chosen, store_of(result))
    assert found.n_computed + found.n_reused == EXPOSURES + STRIPS
    return found.n_computed


@pytest.mark.parametrize(
    ("settings", "made"),
    [
        ({"run": {"exposure_margin_s": 0.5}}, STRIPS),
        ({"match": {"least_correlation": 0.61}}, STRIPS),
        ({"stars": {"false_alarms_per_frame": 0.02}}, EXPOSURES),
    ],
    ids=["run", "match", "stars"],
)
def test_changed_settings_make_again_what_depends_on_them(settings, made, copied):
    count = units_made(*copied, settings)
    # Exposures are always first; strips are made again if the stars' attitudes come out different.
    assert count == made or (made == EXPOSURES and count == EXPOSURES + STRIPS)


def test_changed_pixels_make_again_their_exposure_or_strip(copied: tuple[Path, Path]) -> None:
    dump, result = copied
    chip = sorted((dump / "chips").iterdir())[0]
    times = (chip.stat().st_atime_ns, chip.stat().st_mtime_ns)
    raw = bytearray(chip.read_bytes())
    raw += b"\0"  # content that no reader uses counts as a change, too
    chip.unlink()  # another file of the same times comes in its place
    chip.write_bytes(raw)
    os.utime(chip, ns=times)
    assert units_made(dump, result) == STRIPS
    exposure = sorted((dump / "exposures").iterdir())[0]
    image = cv2.imread(str(exposure), cv2.IMREAD_UNCHANGED)
    image[0, 0] = np.uint8(image[0, 0] ^ 1)
    exposure.unlink()
    assert cv2.imwrite(str(exposure), image)
    assert 1 <= units_made(dump, result) <= 1 + STRIPS


@pytest.mark.parametrize(
    ("changed", "made"),
    [
        ("boresight.geometry.constants", {EXPOSURES + STRIPS}),
        ("boresight.gct_match.locate", {STRIPS, EXPOSURES + STRIPS}),
        ("boresight.star_id.finding.centroid", {EXPOSURES, EXPOSURES + STRIPS}),
        ("boresight.pipeline.report.page", {0}),
        ("a library", {EXPOSURES + STRIPS}),
    ],
)
def test_other_code_or_libraries_make_again_what_depends_on_them(changed, made, copied, monkeypatch):
    """One byte more in the source of a module, or another version of a library, as digests read them. Other
    times of change of the files of the dump do not matter.
    """
    for path in copied[0].rglob("*"):
        os.utime(path, ns=(1, 1))
    read, versions = digests._module.__wrapped__, program_key.library_versions()

    def source(name: str) -> object:
        module = read(name)
        return (module[0] + b"\n", *module[1:]) if module is not None and name == changed else module

    monkeypatch.setattr(digests, "_module", source)
    if changed == "a library":
        monkeypatch.setattr(program_key, "library_versions", lambda: versions | {"scipy": "0.0.1"})
    program_key.program_digest.cache_clear()
    try:
        assert units_made(*copied) in made
    finally:
        program_key.program_digest.cache_clear()


def test_nothing_is_made_again_of_a_dump_with_other_times_of_change(copied: tuple[Path, Path]) -> None:
    dump, result = copied
    for path in dump.rglob("*"):
        os.utime(path, ns=(1, 1))
    assert units_made(dump, result) == 0
