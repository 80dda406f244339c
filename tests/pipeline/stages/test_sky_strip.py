"""Strips of the sky from a dump to the matrix, and what is refused by name."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import ran
from edits import repaint, replaced, rows_of, write_rows
from ledgers import ledger_of_cells
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.diagnosis import losses
from boresight.pipeline.diagnosis.losses import OF_STARS, OF_TARGETS, lost_ccds, named_alone, star_ledger
from boresight.pipeline.diagnosis.readings import exchanged_in_sky, reversed_strips, strips_without_stars
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.images.tiff import StripFiles
from boresight.pipeline.files.text_files import toml_tables
from boresight.pipeline.report.evidence import star_pictures
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.run.unit_store import UnitStore
from boresight.pipeline.stages.sky_side import scatter_px
from boresight.pipeline.stages.sky_strip import find_sky_stars
from boresight.records.ledger import Reason
from boresight.star_id.strip_stars.settings import StripStarSettings

SKY = Path(__file__).parents[3] / "fixtures" / "sky"
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture(scope="module")
def calibration(sky_result, tmp_path_factory):
    """The same once more, from the units of the command."""
    work = shutil.copytree(sky_result / "work", tmp_path_factory.mktemp("store") / "work")
    again = calibrate_dump(open_dump(SKY), store=UnitStore(work))
    assert again.n_computed == 0 and again.n_reused == 13
    written = json.loads((sky_result / "installation.json").read_text())
    assert again.estimate.R_cs.as_matrix().tolist() == written["R_cs"]
    return again


@pytest.fixture(scope="module")
def units(sky_result, tmp_path_factory):
    """Units that are kept: what a test leaves as it was is not made again."""
    return UnitStore(shutil.copytree(sky_result / "work", tmp_path_factory.mktemp("units") / "work"))


@pytest.fixture
def dump(tmp_path):
    shutil.copytree(SKY, tmp_path / "dump")
    return tmp_path / "dump"


def strip_images(dump, change):
    """Every CCD's image changed by a function of its pixels."""
    for path in sorted((dump / "strips").glob("*.tif")):
        repaint(path, change)


def why(dump, units, settings=None):
    with pytest.raises(DataNotSufficientError) as raised:
        calibrate_dump(open_dump(dump), settings or Settings(), units)
    return " ".join(o.text for o in raised.value.omissions if o.subject.kind == "strip")


def test_a_dump_of_the_sky_alone_gives_the_matrix_with_an_honest_covariance(calibration):
    truth = toml_tables(SKY / "truth" / "installation.toml", "")["quaternion_cs"]
    estimate = calibration.estimate
    error = theta_between(estimate.R_cs, Rotation.from_quat(truth))
    assert error @ np.linalg.solve(estimate.cov_theta, error) < 16.3  # 99.9 % of chi-square, three angles
    # 15 stars of a fifth of a 2.5" pixel each, the clock's error of 0.1 ms at 6.7 mrad/s: 0.14" along
    assert np.all(np.sqrt(np.diag(estimate.cov_theta))[:2] < 0.3 * ARCSEC)
    assert calibration.verdict.outcome.value == "consistent"


def test_each_star_has_a_card_with_strip_trace_and_difference(calibration, sky_result):
    for picture in star_pictures(calibration.sky.tasks[0], calibration.named[0]):
        found, fitted = (
            cv2.imdecode(np.frombuffer(png, np.uint8), -1).astype(float)
            for png in (picture.found_png, picture.template_png)
        )
        assert np.corrcoef(found.ravel(), fitted.ravel())[0, 1] > 0.8  # of the faintest star, SNR 9
    stars = len(calibration.strips[0].ground.target_id)
    page = (sky_result / "report.html").read_text()
    assert page.count("trace, as fitted</figcaption>") + page.count("trace, as fitted\\u003c") == stars


def test_names_are_those_of_the_stars_that_cross_there(calibration):
    rows = [line.split(",") for line in (SKY / "truth" / "sky_stars.csv").read_text().splitlines()[1:]]
    true = {(int(r[1]), f"HIP {r[2]}"): (float(r[3]), float(r[4])) for r in rows}
    strip = calibration.strips[0].ground
    assert len(strip.target_id) >= 12 and strip.is_star.all()
    for name, ccd, xy in zip(strip.target_id.tolist(), strip.ccd.tolist(), strip.xy_px):
        assert np.abs(xy - true[ccd, name]).max() < 0.5, name  # px; five sigma of the faintest


def test_a_strip_of_the_sky_called_ground_is_refused_and_so_is_ground_called_sky(dump, demo, tmp_path):
    replaced(dump / "strips.csv", ",sky", ",ground")
    with pytest.raises(RawDataError, match=r"files\.targets"):
        open_dump(dump)
    mini = tmp_path / "mini"
    shutil.copytree(SKY.parent / "mini", mini)
    lines = (mini / "strips.csv").read_text().splitlines()
    kinds = ["kind", *("sky" if line.startswith("s03") else "ground" for line in lines[1:])]
    (mini / "strips.csv").write_text("\n".join(map(",".join, zip(lines, kinds))) + "\n")
    store = UnitStore(shutil.copytree(demo / "demo-result" / "work", tmp_path / "work"))
    found = calibrate_dump(open_dump(mini), store=store)
    assert found.n_computed < 10  # most units of the two strips that stay are those of the demo
    reasons = [o.text for o in found.omissions if o.subject.name == "s03"]
    assert len(reasons) == 1 and "looks at the Earth" in reasons[0]
    assert len(found.strips) == 2


def test_rows_in_reverse_order_are_a_rate_of_the_wrong_sign(dump, units):
    strip_images(dump, lambda pixels: pixels[::-1])
    assert "rows run against the attitudes" in why(dump, units)


def test_a_scan_against_many_stages_is_refused_before_any_pixel_is_read(calibration):
    (task,) = calibration.sky.tasks
    turned = Rotation.from_rotvec([0.0, 0.0, np.pi]) * task.R_cs0
    without_images = replace(task.strip, images=StripFiles({}, {}, {}))
    found = find_sky_stars(replace(task, stages=64, R_cs0=turned, strip=without_images))
    assert "against the motion of the charge" in found.text


def test_a_strip_without_stars_and_one_of_other_stars_say_so(dump, units):
    rng = np.random.default_rng(1)
    strip_images(dump, lambda pixels: np.rint(rng.normal(12.0, 0.9, pixels.shape)).astype(np.uint8))
    assert "no star" in why(dump, units) or "too few stars" in why(dump, units)


def test_a_crowded_field_of_unlisted_stars_is_refused_by_name(dump, units):
    rng = np.random.default_rng(2)

    def crowded(pixels):
        image = rng.normal(12.0, 0.9, pixels.shape)
        for _ in range(150):
            line, sample = (int(rng.integers(4, side - 4)) for side in pixels.shape)
            y, x = np.mgrid[-4:5, -4:5] - rng.uniform(-0.5, 0.5, 2)[:, None, None]
            star = rng.uniform(20, 60) * np.exp(-(x * x + y * y) / 0.94)
            image[line - 4 : line + 5, sample - 4 : sample + 5] += star
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    strip_images(dump, crowded)
    told = why(dump, units, Settings(sky_strips=StripStarSettings(max_stars_per_deg2=200.0)))
    assert re.search(r"too crowded, 3\d\d detections a square degree", told)


def test_a_wrong_kind_and_a_missing_image_are_errors_of_the_table(dump):
    sound = rows_of(dump / "strips.csv")
    moon, none = [sound[0] | {"kind": "moon"}, *sound[1:]], [one | {"file": ""} for one in sound]
    for changed, field in ((moon, "kind"), (none, "file")):
        write_rows(dump / "strips.csv", changed)
        with pytest.raises(RawDataError, match=field):
            open_dump(dump)


def test_the_command_writes_result_report_and_status_of_a_dump_of_the_sky_alone(sky_result):
    page = (sky_result / "report.html").read_text()
    assert page.count('data-link="s') == 6 * 15  # each on the sky, in four panels of residuals, in the table
    assert 'id="targets"' not in page and "No strip has a footprint" not in page
    assert "</data> strip with" in page and "15</data> stars." in page
    assert "strips of the sky" in ran("status", sky_result).output
    assert "1 strips of the sky" in ran("dump", "check", SKY).output


def test_a_camera_stated_so_uncertain_that_no_name_is_sure_says_so(dump, units):
    text = (dump / "dump.toml").read_text()
    (dump / "dump.toml").write_text(re.sub(r"look_distortion_px = \S+", "look_distortion_px = 6.0", text))
    says = r"sky: 1; .*name unsure, .*: of the stated errors look_distortion_px"
    with pytest.raises(DataNotSufficientError, match=says):
        calibrate_dump(open_dump(dump), store=units)


def test_stars_missing_in_a_strip_are_told_by_ccd_by_image_and_by_strip(calibration):
    dump, side, named = open_dump(SKY), calibration.sky, calibration.named
    counts = counted(dump, side, named, calibration)
    seen = [found for found, _ in counts.cells().values()]
    expected = [n for _, n in counts.cells().values()]
    assert sum(expected) >= 15 and sum(seen) == sum(expected)  # no star of this sky is lost
    assert list(strips_without_stars(dump, side, named, counts, [])) == []

    (found,) = side.found
    along = np.where(np.isin(found.ccd, [1, 2]), 300.0, 0.0)
    moved = found.xy_px + np.outer(along, [0.0, 1.0])
    shifted = replace(side, found=(replace(found, xy_px=moved),))
    (one,) = named
    gone = replace_named(one, shifted.found[0], one.rows[~np.isin(found.ccd[one.rows], [1, 2])])
    counts = counted(dump, shifted, [gone], calibration)
    assert lost_ccds(counts, OF_STARS) == [1, 2]
    (alone,) = named_alone(dump, shifted, [gone], counts)  # by its own vote, for the test of its place
    assert set(alone.found.ccd[alone.rows].tolist()) == {1, 2} and len(alone.rows) >= 3
    unsure = replace_named(one, found, one.rows[found.ccd[one.rows] != 1])  # all where they must be
    (alone,) = named_alone(dump, side, [unsure], counted(dump, side, [unsure], calibration))
    assert set(alone.found.ccd[alone.rows].tolist()) == {1} and len(alone.rows) >= 3

    exchanged = replace(found, ccd=np.array([0, 2, 1, 3])[found.ccd])
    gone = replace_named(one, exchanged, one.rows[~np.isin(found.ccd[one.rows], [1, 2])])
    counts = counted(dump, side, [gone], calibration)
    (told,) = exchanged_in_sky(dump, side, [gone], counts, calibration.estimate.R_cs)
    assert told.item == "CCD 1 and CCD 2 in strip sky01" and told.file == "strips.csv"

    empty = replace_named(one, exchanged, one.rows[:0])  # a strip without any name, beside one that has them
    none = nothing_found(counts)
    two = replace(side, tasks=side.tasks * 2, found=side.found * 2)
    (told,) = exchanged_in_sky(dump, two, [empty, one], none, calibration.estimate.R_cs)
    assert told.item == "CCD 1 and CCD 2 in strip sky01"

    empty = replace_named(one, found, one.rows[:0])
    counts = nothing_found(counted(dump, side, named, calibration))
    (told,) = strips_without_stars(dump, side, [empty], counts, [])
    assert told.refutes and "agree by themselves" in told.text  # named by its own vote: contradicts
    assert list(strips_without_stars(dump, side, [empty], counts, ["sky01"])) == []  # a cause explains it
    last = np.array([side.tasks[0].camera.n_px(ccd) - 1.0 for ccd in range(4)])
    mirrored = found.xy_px.copy()
    mirrored[:, 0] = last[found.ccd] - mirrored[:, 0]
    reversed_side = replace(side, found=(replace(found, xy_px=mirrored),))
    (told,) = strips_without_stars(dump, reversed_side, [empty], counts, [])
    assert (told.cause, told.item) == ("order of an image", "strip sky01") and "columns reversed" in told.text
    (alone,) = reversed_strips(dump, reversed_side)  # the only strip: no other one gives a matrix
    assert alone.refutes and alone.item == "strip sky01" and "columns reversed" in alone.text
    assert list(reversed_strips(dump, side)) == []


def test_stars_that_a_ccd_shows_60_lines_off_are_paired_with_the_stars_that_are_missing(calibration):
    dump, side, (one,) = open_dump(SKY), calibration.sky, calibration.named
    off = np.outer(np.isin(one.found.ccd, [1, 2]), [0.0, 60.0])
    found = replace(one.found, xy_px=one.found.xy_px + off)
    gone = replace_named(one, found, one.rows[~np.isin(found.ccd[one.rows], [1, 2])])
    counts = counted(dump, replace(side, found=(found,)), [gone], calibration)
    (far,) = losses.displaced_stars(dump, side, [gone], counts, calibration.estimate.R_cs)
    true, told = (dict(zip(those.rows.tolist(), those.names.tolist())) for those in (one, far))
    both = true.keys() & told.keys()  # others had no name for certain
    assert len(both) >= 4 and all(true[row] == told[row] and off[row, 1] > 0.0 for row in both)


def test_a_star_counts_as_found_within_the_errors_that_are_stated(calibration):
    dump, side, named = open_dump(SKY), calibration.sky, calibration.named
    (found,), (one,) = side.found, named
    kept = {}
    for shift_px in (2.5, 7.0):  # stated: attitudes to some 0.3 px, 0.3 px of distortion, 1 px not stated
        moved = found.xy_px + np.where(found.ccd == 3, shift_px, 0.0)[:, None] * [1.0, 0.0]
        off = replace_named(one, replace(found, xy_px=moved), one.rows)
        counts = counted(dump, side, [off], calibration)
        kept[shift_px], expected = counts.cells()["sky01", 3]
        assert expected >= 2
        assert all(n == of for (_, ccd), (n, of) in counts.cells().items() if ccd != 3)
    assert kept == {2.5: expected, 7.0: 0}


def test_two_exposures_let_stars_lie_as_far_off_as_the_satellite_may_move(calibration):
    dump, (task,) = open_dump(SKY), calibration.sky.tasks
    attitudes = {"t_attitude_s": task.t_attitude_s[:2], "R_si": task.R_si[:2]}
    two = replace(task, **attitudes, covariance_c=task.covariance_c[:2, :, :2])
    moved_px = dump.errors.motion_arcsec * ARCSEC / dump.line_camera.pixel_rad
    assert len(task.t_attitude_s) > 2 and moved_px > 1.0
    assert scatter_px(dump, two) == pytest.approx(np.hypot(scatter_px(dump, task), moved_px))


def nothing_found(ledger):
    """The ledger with every star missing."""
    return replace(ledger, reason=np.full(len(ledger.ccd), Reason.NOT_IN_PLACE.number))


def counted(dump, side, named, calibration):
    """Bright stars that the strips must show, found or not."""
    return star_ledger(dump, side, named, calibration.estimate.R_cs)


def replace_named(one, found, rows):
    """The named stars of a strip of which only the detections `rows` have names."""
    keep = np.isin(one.rows, rows)
    named = {"rows": one.rows[keep], "probability_wrong": one.probability_wrong[keep]}
    return replace(one, found=found, places=one.places.take(np.flatnonzero(keep)), omissions=(), **named)


def test_what_several_ccds_lost_counts_together():
    cloud = {("s", 0): (1, 3), ("s", 1): (2, 3), ("s", 2): (3, 3), ("s", 3): (2, 3)}
    assert lost_ccds(ledger_of_cells(cloud)) == []
    few = {("s", 0): (0, 3), ("s", 1): (5, 5), ("s", 2): (0, 4), ("s", 3): (4, 4)}
    three = ledger_of_cells({**few, ("s", 2): (4, 4)})
    assert lost_ccds(three, OF_STARS_OF_TARGETS) == []  # three stars of one CCD may be chance
    assert lost_ccds(ledger_of_cells(few), OF_STARS_OF_TARGETS) == [0, 2]
    nothing = ledger_of_cells({("s", ccd): (0, 5) for ccd in range(4)})
    assert lost_ccds(nothing) == []  # a strip that shows nothing


OF_STARS_OF_TARGETS = replace(OF_STARS, probability=OF_TARGETS.probability)
