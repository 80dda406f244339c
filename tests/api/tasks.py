"""Tasks that people bring, each done with the names of `import boresight as bs` alone, in five lines.

    python tasks.py MINI MAY JUNE OUT

does them all in any environment that has boresight; MINI is the example, MAY and JUNE are dumps of its strips
s01 and s02, OUT is an empty folder. It prints where
boresight is, then each task that is done, or what it raised.
"""

import datetime
import sys
import traceback
from pathlib import Path
from typing import Any, NamedTuple
from unittest import TestCase

import numpy as np
import pandas as pd
import rasterio
from astropy.time import Time
from wrong_vectors import drawn_vectors

import boresight as bs

ARCSEC = np.pi / 648000.0


class Given(NamedTuple):
    """What the tasks begin with."""

    mini: Path  # the example
    image: Path  # of the sky, 20 deg wide
    pixels: np.ndarray  # the same
    rgb: np.ndarray  # the same in three equal colours
    stars: bs.Stars  # found in it
    solution: bs.StarSolution  # identified with the dump's camera
    dump: Path  # of one strip
    dumps: list[Path]  # two of one strip
    result: bs.Calibration | None  # of `dump`, once it is calibrated
    arrays: dict[str, Any]  # arguments of `dump_from_arrays`: the strip of `dump`
    out: Path


def given_of(mini: Path, dumps: list[Path], out: Path) -> Given:
    image = mini / "exposures" / "e0001.png"
    with rasterio.open(image) as file:
        pixels = file.read(1)
    stars = bs.find_stars(pixels)
    solution = bs.identify(stars, camera=bs.open_dump(mini).star_camera)
    assert solution
    rgb = np.stack([pixels] * 3, axis=2)
    arrays = arrays_of(mini)
    return Given(mini, image, pixels, rgb, stars, solution, dumps[0], dumps, None, arrays, out)


def arrays_of(mini: Path) -> dict[str, object]:
    """Arguments of `dump_from_arrays` from the files of one strip of the example."""

    def read(file: str) -> tuple[np.ndarray, list[float], str]:
        with rasterio.open(mini / file) as one:
            return one.read(1), list(one.transform)[:6], str(one.crs)

    dump = bs.open_dump(mini)
    exposures = pd.read_csv(mini / "exposures.csv").iloc[:14].rename(columns={"utc_mid": "time"})
    strips = pd.read_csv(mini / "strips.csv").iloc[:4].rename(columns={"utc_first_row": "time"})
    targets = pd.read_csv(mini / "targets.csv").iloc[:12]
    chips = [read(file) for file in targets["chip"]]
    states = [line.split() for line in (mini / "orbit.oem").read_text().splitlines() if line[:2] == "20"]
    axes = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")
    return {
        "star_camera": dump.star_camera,
        "remote_camera": dump.line_camera,
        "R_cs0": dump.R_cs0.as_matrix(),
        "sigma_R_cs0_rad": 3e-3,
        "orbit": [
            {"time": Time(t, scale="utc"), **{axis: 1e3 * float(x) for axis, x in zip(axes, numbers)}}
            for t, *numbers in states
        ],
        "exposures": exposures.assign(image=[read(file)[0] for file in exposures["file"]]),
        "strips": strips.assign(image=[lambda file=file: read(file)[0] for file in strips["file"]]),
        "targets": targets.assign(
            chip=[one[0] for one in chips],
            chip_affine=[one[1] for one in chips],
            chip_crs=[one[2] for one in chips],
        ),
        "errors": {
            "position_m": 2.0,
            "clock_s": 1e-4,
            "vibration_arcsec": 0.1,
            "look_distortion_px": 0.03,
            "look_distortion_length_px": 125.0,
        },
        "terrain": read("terrain/dem.tif"),
        "terrain_height_kind": "egm96",
    }


def find_stars_in_a_file(given: Given) -> None:
    stars = bs.find_stars(given.image)
    assert len(stars) > 50


def know_how_good_each_centroid_is(given: Given) -> None:
    table = given.stars.table()
    assert table["sigma_px"].between(0.001, 0.5).all()


def know_which_detections_are_no_stars(given: Given) -> None:
    assert given.stars.misshapen_px.shape[1] == 2
    assert "not used: " in repr(given.stars)


def identify_an_image_with_its_field_of_view(given: Given) -> None:
    solution = bs.identify(given.stars, fov_deg=18.6)
    assert solution and len(solution.hip) > 50


def identify_a_colour_image(given: Given) -> None:
    solution = bs.identify(given.rgb, camera=given.solution.camera)
    assert solution and np.array_equal(solution.hip, given.solution.hip)


def identify_with_a_datetime(given: Given) -> None:
    when = datetime.datetime(2024, 11, 20, 3, 40, 1, 600000, tzinfo=datetime.UTC)
    solution = bs.identify(given.stars, camera=given.solution.camera, time=when)
    assert solution and (solution.R_si * given.solution.R_si.inv()).magnitude() < 25 * ARCSEC


def identify_with_an_astropy_time_and_a_site(given: Given) -> None:
    when = Time("2024-11-20T03:40:01.6", scale="utc")
    solution = bs.identify(given.stars, camera=given.solution.camera, time=when, site=(48.1, 11.6, 500))
    assert solution is not None


def learn_why_an_image_is_not_identified(given: Given) -> None:
    noise = np.random.default_rng(1).normal(100.0, 5.0, (64, 64))
    unknown = bs.identify(noise, fov_deg=20)
    assert not unknown and "stars" in unknown.reason


def right_ascension_and_declination_of_a_pixel(given: Given) -> None:
    sky = given.solution.pixel_to_sky([(511.5, 383.5), (0.0, 0.0)])
    assert abs(sky[0].ra.deg - given.solution.ra_deg) < 1e-6


def world_coordinates_for_other_software(given: Given) -> None:
    wcs = given.solution.wcs()
    ra, dec = wcs.all_pix2world(100.0, 50.0, 0)
    assert given.solution.pixel_to_sky((100.0, 50.0)).separation(wcs.pixel_to_world(100.0, 50.0)).arcsec < 1.0
    assert np.isfinite([ra, dec]).all()


def table_of_identified_stars_with_coordinates(given: Given) -> None:
    table = given.solution.table()
    assert {"hip", "ra_deg", "dec_deg", "residual_x_px"} <= set(table.columns)


def calibrate_a_star_camera(given: Given) -> None:
    images = (given.mini / "exposures" / f"e{n:04d}.png" for n in (1, 15))
    found = bs.calibrate_star_camera(images, fov_deg=18.6)
    assert found and found.rms_px < 0.2


def find_a_template_in_a_picture(given: Given) -> None:
    ground = 100.0 * np.random.default_rng(1).normal(size=(25, 25)).repeat(8, 0).repeat(8, 1)
    match = bs.match_template(ground[60:124, 50:114], ground, start_px=(84, 88))
    assert isinstance(match, bs.Match | bs.NotMatched)


def measure_the_targets_of_a_strip(given: Given) -> None:
    matches = bs.match_targets(given.dump, strips="s01")
    assert len(matches) == 12


def look_into_a_dump(given: Given) -> None:
    dump = bs.open_dump(given.dump)
    assert len(repr(dump).splitlines()) <= 25 and len(dump.strips) == 1


def calibrate_a_dump_into_a_folder(given: Given) -> bs.Calibration:
    result = bs.calibrate(given.dump, out=given.out / "result")
    assert result.verdict == "consistent" and result.folder == given.out / "result"
    return result


def use_some_strips_only_and_compare_with_a_simulated_truth(given: Given) -> None:
    result = bs.calibrate(given.mini, strips=["s01"])
    assert result.targets["strip_id"].unique().tolist() == ["s01"]
    assert "2 strips (not asked for)" in repr(result)
    found = bs.validate(result, given.mini)
    assert found.nees < 16.3 and len(repr(found).splitlines()) <= 25


def read_the_verdict_and_its_checks(given: Given) -> None:
    assert given.result.verdict == "consistent"
    assert not given.result.checks["fails"].any()


def know_what_the_data_cannot_show(given: Given) -> None:
    spots = given.result.blind_spots
    assert "clock of the rows" in set(spots["cause"])


def residuals_of_targets_and_stars(given: Given) -> None:
    targets, stars = given.result.residuals(), given.result.residuals("stars")
    assert len(targets) == 12 and len(stars) > 1000
    assert 1.0 < stars.loc[stars["kept"], "statistic"].median() < 1.8  # chi-square, 2 dof: 1.39


def list_what_was_not_used(given: Given) -> None:
    assert {"kind", "name", "reason"} <= set(given.result.not_used.columns)
    assert "not used: " in repr(given.result)


def write_the_report(given: Given) -> None:
    page = given.result.report(given.out / "report.html")
    text = page.read_text()
    assert 'id="targets"' in text and text.rstrip().endswith("</html>")


def export_to_spice(given: Given) -> None:
    files = given.result.export("spice", given.out / "kernels", dump=given.dump)
    assert "FRAME" in files[0].read_text()


def latitude_and_longitude_of_pixels(given: Given) -> None:
    places = given.result.geolocate("s01", 1, 1000.0, np.arange(10.0, 500.0, 50.0), dump=given.dump)
    assert len(places) == 10 and np.isfinite(places).all(axis=None)


def calibrate_vectors_with_a_matrix(given: Given) -> None:
    u_s, v_stars, sigma_s, w_c, v_targets, sigma_c, R_cs0 = drawn_vectors(np.random.default_rng(3))
    found = bs.calibrate_vectors(u_s, v_stars, sigma_s, w_c, v_targets, sigma_c, R_cs0.as_matrix())
    assert found.verdict == "consistent"


def forecast_a_campaign_from_values(given: Given) -> None:
    plan = bs.forecast({"strips": {"exposures": 3, "stars": 12}, "targets": {"count": 6, "sigma_px": 0.2}})
    assert len(plan.table) > 0 and len(repr(plan).splitlines()) <= 25


def calibrate_several_dumps_jointly(given: Given) -> None:
    joint = bs.calibrate(given.dumps)
    assert joint.dof > 30 and set(joint.targets["strip_id"]) == {"may/s01", "june/s02"}
    assert set(joint.residuals("stars")["dump"]) == {"may", "june"}
    assert joint.geolocate("s02", 0, 10.0, 20.0, dump=given.dumps[1])["lat_deg"].notna().all()
    TestCase().assertRaisesRegex(ValueError, "out=FOLDER", joint.report, given.out / "joint.html")


def calibrate_arrays_in_memory(given: Given) -> None:
    found = bs.calibrate(bs.dump_from_arrays(**given.arrays))
    # rounding of texts
    np.testing.assert_allclose(found.theta, given.result.theta, rtol=0, atol=1e-4 * ARCSEC)
    np.testing.assert_allclose(found.cov_theta, given.result.cov_theta, rtol=1e-6)


# All functions above of what is given alone, in their order.
TASKS = [one for one in list(globals().values()) if getattr(one, "__annotations__", {}).get("given") is Given]


def main() -> None:
    mini, may, june, out = map(Path, sys.argv[1:])
    given = given_of(mini, [may, june], out)
    print(bs.__file__)
    for task in TASKS:
        try:
            given = given._replace(result=task(given) or given.result)
            print(task.__name__)
        except Exception as error:
            traceback.print_exc()
            print(f"{task.__name__}: {error!r}")


if __name__ == "__main__":
    main()
