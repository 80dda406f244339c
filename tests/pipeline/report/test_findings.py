"""What the report asks to look at: each pattern names its cause and its items, and good data give none."""

import re
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import rasterio
from ledgers import ledger_of
from pytest import approx

from boresight.calib.finding import MOST_WORDS
from boresight.gct_match.locate import locate_template
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef, local_axes_e
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.diagnosis.input_findings import heights
from boresight.pipeline.diagnosis.losses import lost_strip, lost_targets
from boresight.pipeline.diagnosis.suspects import single_targets
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.report.findings import clouds, spread
from boresight.pipeline.report.unmatched import pictures_at
from boresight.pipeline.stages.strip import _not_matched, compass, displaced_m, pushbroom_of
from boresight.records.ledger import Entry, Kind, Reason, State, Subject

NAMES = [f"t{n}" for n in range(12)]


@pytest.mark.parametrize(
    ("sign", "kinds"), [(-1.0, ("EGM96", "ellipsoidal")), (1.0, ("ellipsoidal", "EGM96"))]
)
def test_heights_off_by_the_geoid_name_the_kind_of_height(sign, kinds):
    # A height H above EGM96 taken for ellipsoidal is too low by the undulation N: above the terrain by -N.
    geoid_m = -37.5
    (found,) = heights(NAMES, sign * geoid_m + np.linspace(-1.0, 1.0, 12), lambda: geoid_m, {})
    assert found.cause == "kind of height" and found.is_fault
    assert "the targets' heights are {} but stated as {}".format(*kinds) in found.text
    assert f"{sign * geoid_m:+.1f} m (median)" in found.text


def test_other_heights_are_named_by_size_or_by_target_and_noise_is_not():
    noise = np.random.default_rng(3).normal(0.0, 1.5, 12)
    assert list(heights(NAMES, noise, lambda: -37.5, {})) == []
    two_known = np.where(np.arange(12) < 10, np.nan, 200.0)
    assert list(heights(NAMES, two_known, lambda: -37.5, {})) == []
    (offset,) = heights(NAMES, noise + 12.0, lambda: -37.5, {})
    assert offset.cause == "heights of targets or terrain" and "+1" in offset.text
    wrong = noise.copy()
    wrong[4] += 310.0
    (one,) = heights(NAMES, wrong, lambda: -37.5, {})
    assert (one.cause, one.item) == ("height", "target t4") and "+31" in one.text
    of_a_strip = noise + np.where(np.arange(12) < 4, 40.0, 0.0)
    strips = {"strip s1": NAMES[:4], "strip s2": NAMES}
    (four,) = heights(NAMES, of_a_strip, lambda: -37.5, strips)
    assert four.item == "4 targets of strip s1" and four.text.startswith("+40 m above")
    half = noise - np.where(np.arange(12) < 6, 540.0, 0.0)
    (six,) = heights(NAMES, half, lambda: -37.5, {"strip s1": NAMES[:6], "strip s2": NAMES[6:]})
    assert six.item == "6 targets of strip s1" and six.text.startswith("-5")


def test_bright_places_without_contrast_are_clouds_and_dark_ones_are_not():
    used, dark = [(f"u{n}", 100.0, 20.0) for n in range(3)], ("dark", 10.0, 1.0)
    seen = {State.USED: used, State.UNMATCHED: [("white", 240.0, 3.0), dark, ("town", 240.0, 60.0)]}
    (cloud,) = clouds("s1", seen)
    assert cloud.item == "strip s1" and not cloud.is_fault
    assert [target.id for target in cloud.explains] == ["white"]
    assert list(clouds("s1", seen | {State.UNMATCHED: [dark]})) == []
    few = seen | {State.USED: used[:2]}  # too few to know what the ground looks like
    assert list(clouds("s1", few)) == []


def target(strip_id, name, ccd=0):
    return Subject(Kind.TARGET, strip=strip_id, ccd=ccd, id=name)


def suspected(strip_id, name, distance=9.0, ccd=0):
    return SimpleNamespace(subject=target(strip_id, name, ccd), distance=distance)


class Measured:
    """Targets of chips, each stated 30 m too far west."""

    def __init__(self, suspects):
        self.xy_px = {suspect.subject: (10.0, 20.0) for suspect in suspects}

    def is_point(self, subject):
        return False

    def displaced(self, suspect):
        return -30.0, 1.0, 2.5


class Apart(Measured):
    """The same, but each CCD's in a direction of its own."""

    def displaced(self, suspect):
        return *np.array([[-30.0, 1.0], [30.0, 4.0], [2.0, 30.0]])[suspect.subject.ccd].tolist(), 2.5


def single(suspects, ledger, measured=Measured, **more):
    return list(single_targets(suspects, measured(suspects), ledger, **more))


def ledger_of_rows(*rows):
    """A ledger of rows: strip, CCD, id and reason."""
    strips, ccds, names, reasons = zip(*rows)
    return ledger_of(strips, ccds, reasons, names)


def in_view(strips, ccds, n):
    """A ledger of targets that were all found, n in each CCD of each strip."""
    return ledger_of_rows(
        *((s, ccd, f"v{k}", Reason.NONE) for s in strips for ccd in range(ccds) for k in range(n))
    )


THREE = ("s1", "s2", "s3")


def test_a_single_target_that_contradicts_the_rest_is_named_once_with_its_place():
    (found,) = single([suspected("s1", "t1"), suspected("s2", "t1", 12.0)], in_view(THREE, 1, 4))
    assert found.item == "target t1 (strips s1, s2)"
    assert found.explains == (target("s1", "t1"), target("s2", "t1"))
    assert found.is_fault and not found.refutes
    assert "about 30 m west of the true place (12.0 σ)" in found.text
    assert found.value == approx(30.0, abs=0.1) and found.sigma == approx(2.5, abs=0.01)


class Shown(Measured):
    """Targets of chips of one strip at every hundredth line, some of them off in a direction of their own."""

    def __init__(self, n, off, odd=()):
        self.xy_px = {target("s1", f"t{k}", k % 4): (10.0, 100.0 * k) for k in range(n)}
        self.off, self.odd = [suspected("s1", f"t{k}", ccd=k % 4) for k in off], {f"t{k}" for k in odd}

    def displaced(self, suspect):
        return (31.0, -22.0, 2.5) if suspect.subject.id in self.odd else super().displaced(suspect)


@pytest.mark.parametrize("first", range(10))
@pytest.mark.parametrize("n", range(2, 7))
def test_targets_between_two_lines_of_a_strip_that_are_off_alike_are_one_finding_about_its_lines(first, n):
    part = range(first, min(first + n, 12))
    shown = Shown(12, part)
    found = list(single_targets(shown.off, shown, in_view(("s1",), 4, 3), is_explained=True))
    if len(part) < 3:
        assert [one.cause for one in found] == ["coordinates or chip"] * len(part)
        return
    (one,) = found
    assert (one.item, one.file) == (f"strip s1, lines {100 * part[0]} to {100 * part[-1]}", "strips.csv")
    assert one.value == approx(30.0, abs=0.1) and len(one.explains) == len(part)
    assert len(f"{one.cause} {one.item} {one.text}".split()) <= MOST_WORDS
    for other in (Shown(12, part, odd=part[1:2]), Shown(12, range(0, 12, 2)[: len(part)])):
        apart = list(single_targets(other.off, other, in_view(("s1",), 4, 3)))
        assert apart and not [one for one in apart if one.cause.startswith("lines")]


OF_A_STRIP = [suspected("s1", f"t{n}", ccd=n % 3) for n in range(10)]
OF_ALL = [suspected(f"s{k}", f"t{n}", ccd=n % 3) for k in (1, 2, 3) for n in range(9 + k)]
OF_TWO_CCDS = [suspected("s2", f"t{n}", ccd=1 + n % 2) for n in range(11)]


@pytest.mark.parametrize(
    ("off", "ccds", "found", "measured", "item", "file", "words"),
    [
        (OF_A_STRIP, 3, 4, Measured, "10 targets in strip s1", "", ""),
        (OF_ALL, 3, 4, Apart, "33 targets of all strips", "", "x_offset_mm.*targets.csv"),
        (OF_TWO_CCDS, 4, 6, Apart, "CCD 1 and CCD 2 in strip s2", "strips.csv", "exchanged"),
    ],
)
def test_many_targets_are_one_finding_about_what_they_share(off, ccds, found, measured, item, file, words):
    (one,) = single(off, in_view(THREE, ccds, found), measured)
    assert one.item == item and len(one.explains) == len(off) and file in one.file
    assert re.search(words, one.text) and len(f"{one.cause} {one.item} {one.text}".split()) <= MOST_WORDS
    assert single(off, in_view(THREE, ccds, found), is_explained=True) == []


def test_many_targets_of_a_ccd_are_one_finding_about_its_look_directions():
    off = [suspected(f"s{k}", f"t{n}", ccd=2) for k in (1, 2, 3) for n in range(3)]
    found, other = single([*off, suspected("s2", "t9", ccd=1)], in_view(THREE, 3, 4))
    assert found.item == "CCD 2" and len(found.explains) == 9 and "rotation_mrad" in found.text
    assert other.item == "target t9 (strip s2)"


def test_targets_of_several_ccds_that_are_off_alike_are_told_by_how_far():
    """Between others of their strip; where it shows no other, its time may be wrong as well."""
    off = [suspected("s2", f"t{n}", ccd=1 + n % 2) for n in range(11)]
    measured = Measured(off)
    measured.xy_px = {one.subject: (10.0, 100.0 * n) for n, one in enumerate(off)}
    others = {target("s2", f"y{n}", 3): (10.0, 100.0 * n + 50.0) for n in range(11)}
    measured.xy_px |= others
    (found,) = single_targets(off, measured, in_view(THREE, 4, 6))
    assert (found.cause, found.item) == ("coordinates or chip", "11 targets in strip s2")
    assert (
        "about 30 m west of the true place: check lat_deg, lon_deg in targets.csv and the chips."
        in found.text
    )
    measured.xy_px = {name: xy for name, xy in measured.xy_px.items() if name not in others}
    (found,) = single_targets(off, measured, in_view(THREE, 4, 6))
    assert found.text.endswith("; or utc_first_row in strips.csv.") and len(found.explains) == 11


def strip_of(name, lost, found):
    """Rows of a strip with targets lost, by CCD and reason, and found, by CCD."""
    return [
        *((name, ccd, f"x{n}", reason) for n, (ccd, reason) in enumerate(lost)),
        *((name, ccd, f"y{n}", Reason.NONE) for n, ccd in enumerate(found)),
    ]


class Images:
    """Images of four CCDs, those in `flat` without content."""

    ccds = (0, 1, 2, 3)

    def __init__(self, flat=()):
        self.flat = flat

    def shape(self, ccd):
        return 200, 100

    def read(self, ccd, *window):
        return np.arange(6400.0) % (1 if ccd in self.flat else 50)


def lost(rows, explained=(), flat=None):
    images = {name: Images((flat or {}).get(name, ())) for name, *_ in rows}
    entries = [Entry(target(name, key, ccd), reason) for name, ccd, key, reason in rows]
    return list(lost_targets(images, entries, ledger_of_rows(*rows), list(explained)))


def test_ccds_of_which_no_target_is_found_are_one_finding_and_half_of_them_refute():
    cloudy = Reason.LOW_CORRELATION
    one = [row for name in "abc" for row in strip_of(name, [(2, cloudy)] * 3, [0, 1, 3] * 3)]
    (found,) = lost(one)
    assert found.item == "CCD 2" and not found.refutes and len(found.explains) == 9
    assert "0 of 9 targets found, 27 on other CCDs" in found.text
    assert lost(one, [Subject(Kind.CCD, ccd=2)]) == []  # a cause with its size is named already
    two = [row for name in "abc" for row in strip_of(name, [(0, cloudy), (2, cloudy)] * 3, [1, 3] * 3)]
    (both,) = lost(two)
    assert both.item == "CCDs 0, 2" and both.refutes
    cloud = [*strip_of("a", [(2, cloudy)] * 3, [0, 1, 3]), *strip_of("b", [], [0, 1, 2, 3] * 3)]
    assert lost(cloud) == []


def test_an_image_of_one_grey_value_is_a_dead_detector_where_it_is_one():
    grey = Reason.ONE_GREY_VALUE
    rows = [*strip_of("a", [(2, grey)], [0, 1]), *strip_of("b", [(3, grey)], [0])]
    (dead,) = lost(rows, flat={"a": (2,)})
    assert (dead.cause, dead.item) == ("dead detector or empty file", "CCD 2 in strip a")
    assert dead.explains == (target("a", "x0", 2),) and not dead.refutes


def test_displacements_are_told_by_the_compass():
    assert compass(60.0, 0.5) == "60 m east"
    assert compass(-12.0, 7.0) == "12 m west, 7 m north"
    assert compass(0.0, -0.25) == "0.25 m south"


def test_the_place_of_an_inconsistent_chip_is_found_on_the_ground(calibration):
    task, matched = calibration.tasks[0], calibration.matched[0]
    model, name, ccd = pushbroom_of(task), str(matched.target_id[0]), int(matched.ccd[0])
    (p_e,) = [target.p_e for target in task.targets if target.target_id == name]
    lat, lon, _ = geodetic_from_ecef(p_e[None], WGS84)
    east, north, _ = local_axes_e(lat, lon)[0].T
    true_e = p_e - 60.0 * east + 25.0 * north  # the chip lies 60 m east and 25 m south of it
    pixels = [np.concatenate(model.pixels_from_ground(ccd, p[None])) for p in (true_e, p_e)]
    off = tuple((pixels[0] - pixels[1]).tolist())
    subject = Subject(Kind.TARGET, ccd=ccd, id=name)
    refusal = Entry(subject, Reason.INCONSISTENT, value=9.0, limit=4.0, more=off)
    # m: the ground is not a plane
    assert displaced_m(model, p_e, ccd, tuple(pixels[0])) == approx((60.0, -25.0), abs=0.05)
    assert "about 60 m east, 25 m south of the true place" in _not_matched(task, refusal).detail


def test_pictures_of_a_target_that_is_not_matched_are_as_large_as_its_chip_allows(calibration):
    task, matched = calibration.tasks[0], calibration.matched[0]
    model, name, ccd = pushbroom_of(task), str(matched.target_id[0]), int(matched.ccd[0])
    sample, line = matched.xy_px[0].tolist()
    pictures = pictures_at(task, model, name, ccd, matched.xy_px[0], surface_of(task.terrain))
    template, found = (
        cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
        for png in (pictures.template_png, pictures.found_png)
    )
    (chip,) = [file for file in task.chips if file.target_id == name]
    with rasterio.open(chip.path) as opened:
        side_m = opened.width * opened.transform.a
    at = model.ground_points(ccd, sample + np.array([0.0, 100.0]), np.full(2, line), ConstantHeight(0.0))
    side_px = side_m / (np.linalg.norm(at[1] - at[0]) / 100.0)
    assert 64.0 < side_px < 120.0  # so that a wrong factor of 2 shows
    # At most 96 px are shown; the chip is rotated, and pixels are not square, by some per cent.
    assert template.shape == found.shape
    assert template.shape == pytest.approx([min(96.0, side_px)] * 2, rel=0.08)
    assert np.corrcoef(template.ravel(), found.ravel())[0, 1] > 0.9  # it was matched there
    # What a straight line through the grey values leaves has no mean: grey, and at most a tenth is at an end.
    difference = cv2.imdecode(np.frombuffer(pictures.difference_png, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert difference.mean() == pytest.approx(127.5, abs=4.0)
    assert np.mean((difference == 0) | (difference == 255)) < 0.1


def test_a_strip_without_any_match_is_empty_or_another_one():
    strip = Subject(Kind.STRIP, strip="s2")
    assert lost_strip(strip, [target("s2", "a")], all_flat=True).cause == "empty images"
    other = lost_strip(strip, [target("s2", "a")], all_flat=False)
    assert other.item == "strip s2" and "mirrored" in other.text and "utc_first_row" in other.text


def test_targets_in_one_part_of_the_swath_are_a_weakness_and_no_fault():
    (found,) = spread(0.37)
    assert "37%" in found.text and not found.is_fault
    assert list(spread(0.9)) == []


def test_a_strip_window_of_one_grey_value_is_refused_as_such():
    template = np.random.default_rng(1).uniform(0.0, 255.0, (64, 64))
    refused = locate_template(template, np.full((200, 240), 3.0), start_px=(114, 90))
    assert not refused and refused.reason is Reason.ONE_GREY_VALUE
    assert refused.text.startswith("the strip has the grey value 3 ")


def test_a_chip_that_is_too_small_names_its_target_and_strip():
    entry = Entry(target("s07", "quarry", 2), Reason.CHIP_TOO_SMALL, value=12.0, limit=32.0)
    (found,) = lost_targets({}, [entry], ledger_of([], [], []), [])
    assert found.item == "target quarry (strip s07)" and found.explains == (entry.subject,)
    assert found.cause == "pixel size of the chip" and found.text == f"{entry.text}."
