"""Losses by halves of CCDs, of the field and of the stars of a strip."""

import numpy as np

from boresight.pipeline.diagnosis.loss_groups import LookedFor, lost_halves


def looked(name, rng, lost, n=20):
    """A strip of four CCDs of `n` stars each; `lost` says of (ccd, part, magnitude) which are lost."""
    ccd, part = np.repeat(np.arange(4), n), rng.uniform(size=4 * n)
    magnitude = rng.uniform(3.0, 8.0, 4 * n)
    return LookedFor(
        strip_id=name, ccd=ccd, part=part, magnitude=magnitude, found=~lost(ccd, part, magnitude)
    )


def chance(rng, share):
    """Losses of each star alike."""
    return lambda ccd, part, magnitude: rng.uniform(size=len(ccd)) < share


def told(strips, share=0.04, probability=1e-3, **options):
    return [one.item for one in lost_halves(strips, share, probability, "stars", **options)]


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


def test_what_one_strip_of_the_ground_lost_may_be_a_cloud():
    rng = np.random.default_rng(3)
    cloud = looked("a", rng, lambda ccd, part, magnitude: ccd + part < 2.0)
    clear = looked("b", rng, chance(rng, 0.0))
    assert told([cloud, clear], 0.3, 1e-4, fewest_strips=2) == []
    again = [looked(name, rng, lambda ccd, part, magnitude: ccd + part < 1.9) for name in "ab"]
    assert "first half of the field" in told(again, 0.3, 1e-4, fewest_strips=2)


def test_a_ccd_without_any_star_is_no_half_of_the_field():
    """4 of 9 stars are left in the first half of the field, all of the lost ones on CCD 1."""
    ccd = np.repeat(np.arange(4), (4, 5, 5, 5))
    one = LookedFor(
        strip_id="s", ccd=ccd, part=np.full(19, 0.4), magnitude=np.full(19, np.nan), found=ccd != 1
    )
    assert told([one]) == []
    assert one.without(["CCD 1", "strip s"]).ccd.tolist() == [0] * 4 + [2] * 5 + [3] * 5
