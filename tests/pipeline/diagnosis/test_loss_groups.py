"""Losses by halves of CCDs, of the field and of the stars of a strip; CCDs of which nothing is found are at
fault themselves where most others agree, else the matrix is refuted.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from ledgers import ledger_of

from boresight.pipeline.diagnosis import losses
from boresight.pipeline.diagnosis.losses import OF_STARS, OF_TARGETS, lost_groups
from boresight.records.ledger import Kind, Reason, Subject


def looked(name, rng, lost, n=20):
    """Rows of a strip of four CCDs of `n` stars each; `lost` says which (ccd, part, magnitude) are lost."""
    ccd, part = np.repeat(np.arange(4), n), rng.uniform(size=4 * n)
    magnitude = rng.uniform(3.0, 8.0, 4 * n)
    return [name] * len(ccd), ccd, np.where(lost(ccd, part, magnitude), 1, 0), part, magnitude


def ledger_of_strips(strips):
    names, ccd, lost, part, magnitude = ([value for strip in strips for value in strip[k]] for k in range(5))
    reasons = [Reason.NOT_IN_PLACE if gone else Reason.NONE for gone in lost]
    return ledger_of(names, ccd, reasons, part=part, magnitude=magnitude, kind=Kind.STAR)


def chance(rng, share):
    """Losses of each star alike."""
    return lambda ccd, part, magnitude: rng.uniform(size=len(ccd)) < share


def told(strips, limits=OF_STARS):
    return [finding.item for finding in lost_groups(ledger_of_strips(strips), limits)]


def test_of_two_thousand_good_strips_no_more_than_the_stated_rate_is_told():
    """With 0.1 % asked for, five or more of 2000 occur once in 19."""
    rng = np.random.default_rng(1)
    runs = [told([looked("s", rng, chance(rng, 0.04), n=8)]) for _ in range(2000)]
    assert sum(bool(items) for items in runs) <= 5


def test_a_half_is_told_where_its_other_half_is_whole():
    rng = np.random.default_rng(2)
    of_ccd = looked("s", rng, lambda ccd, part, magnitude: (ccd == 2) & (part > 0.55))
    assert told([of_ccd]) == ["second half of CCD 2"]
    of_field = looked("s", rng, lambda ccd, part, magnitude: ccd + part < 1.9)
    assert "first half of the field" in told([of_field])
    faint = looked("s", rng, lambda ccd, part, magnitude: magnitude > 5.8)
    assert [item.rpartition(" ")[0] for item in told([faint])] == ["strip s, fainter than V"]
    bright = looked("s", rng, lambda ccd, part, magnitude: magnitude < 5.2)
    assert [item.rpartition(" ")[0] for item in told([bright])] == ["strip s, brighter than V"]
    whole = looked("s", rng, lambda ccd, part, magnitude: ccd == 2)
    assert told([whole]) == []  # that is another finding


def test_the_second_half_of_the_lines_of_a_scan_is_told_where_lines_are_missing_in_its_middle():
    rng = np.random.default_rng(4)
    names, ccd, _, part, magnitude = looked("s", rng, chance(rng, 0.0))
    along = rng.uniform(size=len(ccd))
    reasons = [Reason.NOT_IN_PLACE if late else Reason.NONE for late in along > 0.5]
    ledger = ledger_of(names, ccd, reasons, part=part, along=along, magnitude=magnitude, kind=Kind.STAR)
    (told_of_lines,) = lost_groups(ledger, OF_STARS)
    assert told_of_lines.item == "second half of the lines of strip s"
    assert told_of_lines.subjects == (Subject(Kind.STRIP, strip="s"),)


def test_what_one_strip_of_the_ground_lost_may_be_a_cloud():
    rng = np.random.default_rng(3)
    cloud = looked("a", rng, lambda ccd, part, magnitude: ccd + part < 2.0)
    clear = looked("b", rng, chance(rng, 0.0))
    assert told([cloud, clear], OF_TARGETS) == []
    again = [looked(name, rng, lambda ccd, part, magnitude: ccd + part < 1.9) for name in "ab"]
    assert "first half of the field" in told(again, OF_TARGETS)


def test_a_ccd_without_any_star_is_no_half_of_the_field():
    """4 of 9 stars are left in the first half of the field, all of the lost ones on CCD 1."""
    ccd = np.repeat(np.arange(4), (4, 5, 5, 5))
    reasons = [Reason.NOT_IN_PLACE if number == 1 else Reason.NONE for number in ccd]
    ledger = ledger_of(["s"] * 19, ccd, reasons, part=0.4, kind=Kind.STAR)
    assert list(lost_groups(ledger, OF_STARS)) == []
    left = ledger.take(~ledger.within([Subject(Kind.CCD, ccd=1), Subject(Kind.CCD, strip="other", ccd=2)]))
    assert left.ccd.tolist() == [0] * 4 + [2] * 5 + [3] * 5
    assert not replace(ledger, strips=("t",)).within([Subject(Kind.STRIP, strip="s")]).any()


@pytest.mark.parametrize(
    ("ccds", "displaced", "dead", "refutes"),
    [
        (4, {0}, set(), False),
        (4, {0}, {2}, True),  # one against two, which may stand in one row of the focal plane
        (4, {0, 2}, set(), True),
        (3, {1}, set(), True),
        (12, {3, 7, 11}, set(), False),
        (12, {3, 7, 11}, {1, 5, 9}, True),
        (12, {0, 2, 4, 6, 8, 10}, set(), True),
    ],
)
def test_displaced_ccds_refute_unless_twice_as_many_others_agree(ccds, displaced, dead, refutes, monkeypatch):
    ccd = np.repeat(np.arange(ccds), 12)
    reasons = [Reason.NOT_IN_PLACE if one in displaced | dead else Reason.NONE for one in ccd.tolist()]
    ledger = ledger_of(["sky01"] * len(ccd), ccd, reasons, kind=Kind.STAR)
    monkeypatch.setattr(losses, "is_flat", lambda images, one, *counts: one in dead)
    told = list(losses.lost_stars({"sky01": SimpleNamespace(ccds=range(ccds))}, ledger, []))
    (moved,) = (one for one in told if one.cause == "images or look directions of a CCD")
    assert moved.refutes is refutes
    assert {subject.ccd for subject in moved.subjects} == displaced
    assert {subject.ccd for one in told if one is not moved for subject in one.subjects} == dead
