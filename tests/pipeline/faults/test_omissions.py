"""A dump with many damaged images is calibrated from the rest; each is counted and told with its reason."""

import re
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from command_line import ran
from fixture_strips import stopped_run
from test_images import claiming


@pytest.fixture(scope="module")
def damaged(finished: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """The result of the damaged dump, and what was done to which file with what must be said of it."""
    folder = tmp_path_factory.mktemp("damaged")
    dump, out = folder / "dump", folder / "result"
    shutil.copytree(finished[0], dump)
    stopped_run(out, [dump], finished[1])  # sound exposures need not be made again
    exposures, chips = (sorted((dump / kind).iterdir()) for kind in ("exposures", "chips"))
    said = {
        exposures[2]: ("exposure", "byte 0: found an empty file, expected a PNG, TIFF or FITS image"),
        exposures[4]: ("exposure", "byte [0-9]+: found end of file, expected the rest of the PNG chunk"),
        exposures[6]: ("exposure", "file: found no such file, expected an image"),
        exposures[8]: ("exposure", "image size: found 1000000 x 1000000 px, expected 1024 x 768 px"),
        chips[1]: ("chip", "file: found no such file, expected an image"),
        chips[5]: ("chip", "file: found no such file, expected an image"),
    }
    half = exposures[4].read_bytes()[:20_000]
    for path in said:
        path.unlink()
    exposures[2].touch()
    exposures[4].write_bytes(half)
    claiming(exposures[8], 10**6, 10**6, tile=256)
    told = ran("calibrate", dump, "--out", out, "--workers", 1, "--no-report").output
    (folder / "told.txt").write_text(told)
    return folder, {path.relative_to(dump).as_posix(): what for path, what in said.items()}


def test_each_damaged_image_is_an_omission_with_its_reason(damaged: tuple[Path, dict]) -> None:
    folder, said = damaged
    table = pq.read_table(folder / "result/sightings/ledger.parquet").to_pylist()
    rows = {row["file"]: row for row in table if row["kind"] in ("exposure", "ccd", "strip", "chip")}
    assert set(rows) == set(said)
    for file, (kind, reason) in said.items():
        assert rows[file]["kind"] == kind
        assert rows[file]["reason"].startswith(f"{file}: ")
        assert re.search(reason, rows[file]["reason"]), rows[file]


def test_the_command_and_status_count_what_is_not_used(damaged: tuple[Path, dict]) -> None:
    folder, said = damaged
    told = (folder / "told.txt").read_text()
    counts = told[told.index("not used") :]
    assert "2 chips: 2 file not usable" in counts and "4 exposures: 4 file not usable" in counts
    status = ran("status", folder / "result").output
    assert re.search(r"exposures +14 done, 4 not used", status), status
    assert re.search(r"targets, round 2 +1 done, [0-9]+ not used", status), status
    assert status.count("file: found no such file, expected an image") >= 3
    assert len(said) == 6
