"""Noise that `boresight noise --write` states in a dump is what the dump's reader finds; all else stays."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from handmade_sentinel2 import POINT, write_sentinel2

from boresight.features.operators.imported_mission import write_imported
from boresight.features.operators.sentinel2_import import sentinel2_mission
from boresight.features.operators.sentinel2_product import read_sentinel2
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.stated_noise import state_noise

MINI = Path(__file__).parents[3] / "fixtures" / "mini"
NOISE = {
    name: AttitudeNoise(
        white_rad=np.array([0.71, 0.9, 6.0 + n]) * ARCSEC,
        correlated_rad=np.array([0.4, 0.0, 4.7]) * ARCSEC,
        correlation_time_s=np.array([0.5, 0.8, 1.25]),
        constant_rad=np.array([0.3, 0.2, 2.3]) * ARCSEC,
    )
    for n, name in enumerate(("STR1", "STR2"))
}
PARTS = ("white_rad", "correlated_rad", "correlation_time_s", "constant_rad")


@pytest.fixture
def dump(tmp_path):
    strip = read_sentinel2(write_sentinel2(tmp_path), tmp_path, "B04")
    write_imported(tmp_path / "dump", sentinel2_mission([strip], "test"), POINT)
    return tmp_path / "dump"


def test_noise_that_is_written_is_read_and_comments_stay(dump):
    path = dump / "dump.toml"
    # what no record shows
    periodic = "[star_cameras.noise]\nperiodic_arcsec = [6.0, 4.0, 9.0]\nperiod_s = 5920.0"
    text = path.read_text().replace("[light]", "[light]  # as the operator's software\n# by hand")
    path.write_text(text.replace("[star_cameras.noise]", periodic))
    before = path.read_text().splitlines()
    for _ in range(2):  # a second time it replaces what the first stated
        assert state_noise(dump, NOISE) == path
        for head in open_dump(dump).heads:
            for part in PARTS:  # four digits are written
                stated, found = getattr(NOISE[head.name], part), getattr(head.noise, part)
                assert np.allclose(found, stated, rtol=1e-3), part
            assert np.allclose(head.noise.periodic_rad / ARCSEC, [6.0, 4.0, 9.0])
            assert head.noise.period_s == 5920.0
    changed = [line for line in before if line not in path.read_text().splitlines()]
    assert 'origin = "assumed"' in changed  # `import` assumed it, now it is estimated
    assert all("arcsec" in line or "origin" in line or line.strip(" ],.0123456789") == "" for line in changed)
    assert "[light]  # as the operator's software\n# by hand" in path.read_text()


def test_rows_with_errors_of_their_own_get_no_second_white_noise(dump):
    rows = (dump / "STR1.csv").read_text().splitlines()
    sigma = ["sigma_x_arcsec,sigma_y_arcsec,sigma_z_arcsec"] + ["1,1,8"] * (len(rows) - 1)
    (dump / "STR1.csv").write_text("".join(f"{row},{own}\n" for row, own in zip(rows, sigma)))
    text = (dump / "dump.toml").read_text()
    first = text.index("[star_cameras.noise]")
    (dump / "dump.toml").write_text(text[:first] + text[text.index("[[star_cameras]]", first) :])
    state_noise(dump, NOISE)
    one, two = open_dump(dump).heads
    assert np.all(one.noise.white_rad == 0.0) and np.all(two.noise.white_rad > 0.0)
    assert np.allclose(one.noise.constant_rad, NOISE["STR1"].constant_rad, rtol=1e-3)


def test_dump_of_one_star_camera_with_images_is_refused_and_unchanged(tmp_path):
    shutil.copytree(MINI, tmp_path / "mini", ignore=shutil.ignore_patterns("*.tif", "*.png"))
    before = (tmp_path / "mini" / "dump.toml").read_bytes()
    with pytest.raises(RawDataError, match="star_cameras"):
        state_noise(tmp_path / "mini", NOISE)
    assert (tmp_path / "mini" / "dump.toml").read_bytes() == before
