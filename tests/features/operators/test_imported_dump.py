"""A dump that `import` writes says what it was given, and the white noise of attitudes is the drawn one."""

from dataclasses import replace

import numpy as np
from handmade_sentinel2 import POINT, write_sentinel2
from scipy.spatial.transform import Rotation

from boresight.features.operators.imported_mission import white_noise_rad, write_imported
from boresight.features.operators.sentinel2_import import sentinel2_mission
from boresight.features.operators.sentinel2_product import read_sentinel2
from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.pipeline.files.dump import open_dump


def test_white_noise_is_that_about_each_axis_of_the_head():
    rng, drawn = np.random.default_rng(3), np.array([1.3, 0.4, 7.0]) * ARCSEC
    t = 0.125 * np.arange(4000)
    start = Rotation.from_euler("xyz", [40, -65, 110], True)
    even = Rotation.from_rotvec(np.outer(t, [1e-3, -4e-4, 7e-4])) * start
    errors = Rotation.from_rotvec(drawn * rng.standard_normal((len(t), 3)))
    found = white_noise_rad(t, even * errors)  # frame s to GCRS: errors about the axes of s
    assert np.allclose(found, drawn, rtol=0.06)  # four standard errors of 4000 rows, of which a few are alike
    assert np.allclose(white_noise_rad(t, even), 1e-3 * ARCSEC)  # the least that is stated


def test_dump_holds_cameras_heads_noise_strips_and_earth_as_given(tmp_path):
    mission = sentinel2_mission([read_sentinel2(write_sentinel2(tmp_path), tmp_path, "B04")], "by hand")
    heads = tuple(
        replace(head, white_rad=np.array([0.7 + n, 1.9, 11.0 - n]) * ARCSEC)
        for n, head in enumerate(mission.heads)
    )
    strips = tuple(replace(one, row_period_s=1.56580123e-3) for one in mission.strips)
    days = mission.earth_orientation.mjd_utc
    assert isinstance(mission.earth_orientation, EarthOrientationTable)
    mission = replace(mission, heads=heads, strips=strips, errors=mission.errors | {"position_m": 3.5})
    write_imported(tmp_path / "dump", mission, POINT)
    dump = open_dump(tmp_path / "dump")
    for given, found in zip(mission.heads, dump.heads, strict=True):
        assert np.allclose(found.noise.white_rad, given.white_rad, rtol=1e-4), given.name
        assert (found.R_cs0 * given.R_cs0.inv()).magnitude() < 1e-12
        rows = found.source.rows
        utc = dump.epoch.utc_from_seconds(rows.t_s)
        assert list(utc) == list(mission.epoch.utc_from_seconds(given.t_s))
        assert np.max((rows.R_si * given.R_is).magnitude()) < 1e-12
    for ccd in range(dump.line_camera.n_ccds):
        sample = np.arange(float(dump.line_camera.n_px(ccd)))
        cameras = dump.line_camera, mission.cameras[""]
        ours, theirs = (one.directions_from_pixels(ccd, sample) for one in cameras)
        assert np.allclose(ours, theirs, atol=1e-15)
        (strip,) = (one for one in mission.strips if one.ccd == ccd)
        (read,) = dump.strips
        assert read.row_period_s == strip.row_period_s
        assert read.ccd_lines[ccd] == strip.lines
        row = read.first_row[ccd] * read.row_period_s
        utc = dump.epoch.utc_from_seconds([read.t_first_row_s + row])[0]
        off = (
            dump.epoch.seconds_from_utc([utc])[0]
            - dump.epoch.seconds_from_utc([mission.epoch.utc_from_seconds([strip.t_first_row_s])[0]])[0]
        )
        assert abs(off) < 2e-9
    assert dump.errors.position_m == 3.5
    text = (tmp_path / "dump" / "earth_orientation.csv").read_text().splitlines()[1:]
    assert [float(row.split(",")[0]) for row in text] == list(days)
