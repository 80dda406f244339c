"""One template in one window: what looks alike is not taken for it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from rendered_pairs import Pair, make_pair
from scipy import ndimage

from boresight.gct_match.imaging.views import normalised, view_of
from boresight.gct_match.locate import locate, locate_template
from boresight.gct_match.records import TemplateMatch, not_matched
from boresight.gct_match.search import correlation as module
from boresight.gct_match.search.correlation import self_similarity
from boresight.gct_match.settings import MatchSettings
from boresight.records.ledger import Entry, Reason

MARGIN = 16
SETTINGS = MatchSettings()
TRUSTING = replace(SETTINGS, sigma_self_similar_px=SETTINGS.sigma_px)


def estate(rng: np.random.Generator, side: int) -> NDArray:
    """Roofs of two slopes, of various tones, sizes and places in plots of 140 picture pixels."""
    out = np.full((side, side), 80.0, np.float32)
    for top in range(20, side - 100, 140):
        for left in range(20, side - 100, 140):
            tone = rng.normal(150.0, 25.0)
            high, wide = rng.integers(75, 110, 2)
            y, x = np.array([top, left]) + rng.integers(0, 15, 2)
            out[y : y + high // 2, x : x + wide] = tone
            out[y + high // 2 : y + high, x : x + wide] = 0.6 * tone
    grain = ndimage.gaussian_filter(rng.standard_normal(out.shape).astype(np.float32), 3.0)
    return np.clip(out + 5.0 / grain.std() * grain, 0.0, 255.0).astype(np.float32)


def looked_for(template: NDArray, window: NDArray, settings: MatchSettings) -> TemplateMatch | Entry:
    middle = (np.array(template.shape[::-1]) - 1.0) / 2.0
    here = MARGIN, MARGIN
    views = (view_of(image, image > 0.0) for image in (template, window))
    return locate(*views, here, MARGIN, middle, settings)


def pair_of(half: NDArray, seed: int) -> Pair:
    return make_pair(half, np.random.default_rng(seed), size_px=64, margin_px=MARGIN, condition="clean")


def test_look_alikes_of_an_estate_are_told_apart_by_how_well_they_can_be_placed():
    one, two = np.array_split(estate(np.random.default_rng(3), 1200), 2)
    for here, there in ((0, 2), (2, 20), (7, 15)):
        template, window = pair_of(one, here).template, pair_of(two, there).window
        assert isinstance(looked_for(template, window, TRUSTING), TemplateMatch)  # all else speaks for it
        outcome = looked_for(template, window, SETTINGS)
        assert isinstance(outcome, Entry)
        assert outcome.reason is Reason.SELF_SIMILAR
        right = looked_for(template, pair_of(one, here).window, SETTINGS)
        # 0.05 px is asked for where things are alike; the very same houses leave noise alone, 0.01 px
        assert np.sqrt(right.cov_px.max()) < 0.02


def test_picture_is_like_itself_where_it_holds_things_of_one_kind(invented: NDArray):
    every = np.ones((128, 128), dtype=bool)
    houses = estate(np.random.default_rng(5), 700)[::4, ::4][:128, :128]
    ground = np.ascontiguousarray(invented[:512:4, :512:4])
    assert self_similarity(normalised(np.ascontiguousarray(houses), every)) > 0.5
    assert self_similarity(normalised(ground, every)) < 0.4
    tile = ground[:32, :32]
    assert self_similarity(normalised(np.tile(tile, (4, 4)), every)) > 0.95  # a copy, but for its frame


def test_two_arrays_give_the_position_of_the_templates_centre(invented: NDArray):
    pair = make_pair(invented, np.random.default_rng(8), size_px=64, margin_px=MARGIN, condition="clean")
    true = pair.offset_px + 31.5  # px: centre of 64
    match = locate_template(pair.template, pair.window, (true[0] + 3.2, true[1] - 2.7), 8)
    assert np.abs(match.xy_px - true).max() < 0.02  # px: 4 times the bound of this chip
    assert match.cov_px.shape == (2, 2) and match.correlation > 0.9
    assert "correlation" in repr(match)


def test_pixels_that_are_nan_are_not_used(invented: NDArray):
    pair = make_pair(invented, np.random.default_rng(8), size_px=64, margin_px=MARGIN, condition="clean")
    template = pair.template.copy()
    template[:20] = np.nan
    match = locate_template(template, pair.window, tuple(pair.offset_px + 31.5))
    assert np.abs(match.xy_px - pair.offset_px - 31.5).max() < 0.02  # px


def test_a_template_that_is_not_found_is_refused_with_reason_and_numbers(invented: NDArray):
    pair = make_pair(invented, np.random.default_rng(8), size_px=64, margin_px=MARGIN, condition="clean")
    outside = locate_template(pair.template, pair.window, (400.0, 20.0))
    assert not outside and isinstance(outside, Entry)
    assert outside.reason is Reason.FEW_VALID_PIXELS
    assert str(outside).startswith("0% of the template's pixels are valid")
    assert "40% are needed" in str(outside)


@pytest.mark.parametrize(
    ("shape", "radius", "says"),
    [((20, 64), 8, "32 px"), ((64,), 8, "two-dimensional"), ((64, 64), 3, "radius_px")],
)
def test_arrays_that_cannot_be_matched_are_named(shape: tuple[int, ...], radius: int, says: str):
    with pytest.raises(ValueError, match=says):
        locate_template(np.zeros(shape), np.zeros((128, 128)), (64.0, 64.0), radius)


SPOILT = {
    "whole": lambda rng, t, p: None,
    "flat template": lambda rng, t, p: t.fill(5.0),
    "flat picture": lambda rng, t, p: p.fill(5.0),
    "half flat": lambda rng, t, p: t[:, t.shape[1] // 2 :].fill(t[0, 0]),
    "rows alike": lambda rng, t, p: np.copyto(t, t[:1].copy()),
    "one pixel": lambda rng, t, p: (t.fill(0.0), t[-1:, -1:].fill(1.0)),
    "gaps": lambda rng, t, p: [np.putmask(x, rng.random(x.shape) < rng.random(), np.nan) for x in (t, p)],
    "half a picture": lambda rng, t, p: p[:, p.shape[1] // 2 :].fill(np.nan),
    "two levels": lambda rng, t, p: [np.copyto(x, x > np.median(x)) for x in (t, p)],
    "infinite": lambda rng, t, p: (t[0, :1].fill(np.inf), p[-1, :1].fill(-np.inf)),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("spoilt", SPOILT)
def test_any_two_arrays_give_a_position_a_refusal_or_the_stated_error(spoilt: str):
    """Sides of 1 to 512 px, windows of all sizes, types, grey levels up to 1e15."""
    rng = np.random.default_rng([*spoilt.encode()])
    for _ in range(20):
        (h, w), (H, W) = np.exp(rng.uniform(0.0, np.log(512.0), (2, 2))).astype(int).tolist()
        least, radius = int(rng.choice([8, 16, 24, 32])), int(rng.choice([4, 9, 30]))
        if rng.random() < 0.7:  # a window that holds the template
            h, w = max(h, least), max(w, least)
            H, W = h + 2 * radius + 16, w + 2 * radius + 16
        ground = ndimage.gaussian_filter(rng.normal(size=(max(H, h), max(W, w))), rng.choice([0.0, 0.7, 3.0]))
        ground = 100.0 + float(rng.choice([1e-6, 1.0, 1e6, 1e14])) * ground
        x, y = min(radius + 8, ground.shape[1] - w), min(radius + 8, ground.shape[0] - h)
        template, picture = ground[y : y + h, x : x + w].copy(), ground[:H, :W].copy()
        picture += rng.choice([0.0, 0.3]) * ground.std() * rng.normal(size=picture.shape)
        SPOILT[spoilt](rng, template, picture)
        if (np.abs(ground) < 250.0).all() and np.isfinite(template).all() and np.isfinite(picture).all():
            kind = rng.choice(["u1", "u2", "f2", "f4"])
            template, picture = template.astype(kind), picture.astype(kind)
        settings, middle = replace(SETTINGS, smallest_template_px=least), (x + (w - 1) / 2, y + (h - 1) / 2)
        if min(h, w) < least:
            with pytest.raises(ValueError, match="px are needed"):
                locate_template(template, picture, middle, radius, settings=settings)
            continue
        outcome = locate_template(template, picture, middle, radius, settings=settings)
        if isinstance(outcome, TemplateMatch):
            assert np.isfinite(outcome.xy_px).all() and np.linalg.eigvalsh(outcome.cov_px).min() > 0.0
            assert 0.0 <= outcome.probability_wrong <= 1.0 and 0.0 <= outcome.correlation <= 1.0
        else:
            assert isinstance(outcome.reason, Reason) and outcome.text


def test_every_reason_of_the_matcher_has_a_sentence():
    first, last = Reason.OUTSIDE_REACH.number, Reason.INCONSISTENT.number
    for reason in list(Reason)[first : last + 1]:
        said = not_matched(reason, 0.5, 0.25, (3.0, 4.0, 5.0)).text
        assert said and "nan" not in said


def test_of_two_peaks_the_one_with_the_higher_correlation_is_accepted(invented: NDArray):
    # A window of 64 + 2 * 80 px that holds the template and, 72 px away, a blend of it with other ground.
    rng = np.random.default_rng(12)
    chip, other = (np.array(invented[k : k + 256 : 4, k : k + 256 : 4]) for k in (100, 600))
    window = np.array(invented[800 : 800 + 4 * 224 : 4, : 4 * 224 : 4])[:144, :224]
    window = np.pad(window, ((0, 80), (0, 0)), mode="reflect") + rng.normal(0.0, 2.0, (224, 224))
    window[80:144, 80:144] = chip
    window[80:144, 152:216] = 0.8 * chip + 0.5 * other
    views = [view_of(p.astype(np.float32), np.ones(p.shape, dtype=bool)) for p in (chip, window)]
    match = locate(*views, (80, 80), 80, np.array([31.5, 31.5]), SETTINGS)
    assert match.xy_px == pytest.approx([111.5, 111.5], abs=0.05)  # px: other noise in template and window
    assert np.sum(match.surface > 0.7 * match.surface.max()) >= 2  # both peaks were tried


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"least_correlation": 0.999}, Reason.LOW_CORRELATION),
        ({"sigma_px": 1e-4}, Reason.UNCERTAIN_POSITION),
        ({"probability_wrong": 0.0}, Reason.PROBABLY_WRONG),
    ],
)
def test_a_position_beyond_a_limit_is_refused_with_value_and_limit(invented, limits, reason):
    pair = make_pair(invented, np.random.default_rng(8), size_px=64, margin_px=MARGIN, condition="clean")
    start = (pair.offset_px[0] + 31.5, pair.offset_px[1] + 31.5)
    refused = locate_template(pair.template, pair.window, start, settings=replace(SETTINGS, **limits))
    assert isinstance(refused, Entry) and refused.reason is reason
    assert refused.limit == next(iter(limits.values()))
    assert np.isfinite(refused.value)


def test_target_that_is_rarely_visible_is_found_less_surely(monkeypatch: pytest.MonkeyPatch):
    half, rng = estate(np.random.default_rng(3), 1200), np.random.default_rng(4)
    pair = make_pair(half, np.random.default_rng(8), size_px=32, margin_px=MARGIN, condition="clean")
    noisy = np.clip(pair.window + rng.normal(0.0, 40.0, pair.window.shape), 1.0, 255.0).astype(np.float32)
    limits = {"sigma_px": 9.0, "sigma_self_similar_px": 9.0, "probability_wrong": 1.0}
    lenient = replace(SETTINGS, least_correlation=0.01, **limits)
    wrong = []
    for absent in (0.05, 0.5, 0.95):
        monkeypatch.setattr(module, "_PRIOR_ABSENT", absent)
        match = looked_for(pair.template, noisy, lenient)
        wrong.append(match.probability_wrong)
    # w = (e + c o) / (1 + c o) with o = absent / (1 - absent) and c a constant: two give the third.
    sure = [1.0 / (1.0 - w) for w in wrong]  # = (1 + c o) / (1 - e)
    slope = (sure[1] - sure[0]) / (1.0 - 1.0 / 19.0)
    third = sure[1] + slope * 18.0
    assert slope > 1e-4 and sure[2] == pytest.approx(third, rel=1e-6)  # correlations are single precision


@pytest.mark.parametrize("gain", [1e-12, 3e-4, 7e8])
def test_unit_of_the_grey_values_moves_no_position(aerial: NDArray, gain: float):
    pair = make_pair(aerial, np.random.default_rng(6), size_px=64, margin_px=MARGIN, condition="clean")
    sound = locate_template(pair.template, pair.window, (MARGIN + 31.5, MARGIN + 31.5), MARGIN)
    there = gain * pair.template.astype(float), 1e-3 * gain * pair.window.astype(float)
    found = locate_template(*there, (MARGIN + 31.5, MARGIN + 31.5), MARGIN)
    assert np.abs(found.xy_px - sound.xy_px).max() < 1e-3  # px
    assert np.allclose(found.cov_px, sound.cov_px, rtol=0.1)
