"""CCDs of which nothing is found: their own fault where most others agree, else the matrix is refuted."""

from types import SimpleNamespace

import numpy as np
import pytest
from ledgers import ledger_of

from boresight.pipeline.diagnosis import losses
from boresight.records.ledger import Kind, Reason


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
