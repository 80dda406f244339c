"""Pairs of which more has changed than is common: kept, with errors as stated, whatever their contrast."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from test_locate import MARGIN, SETTINGS, looked_for

from boresight.gct_match.records import TemplateMatch
from boresight.gct_match.search.correlation import probability_wrong
from boresight.gct_match.search.edges import agreeing_parts, distinct_edges
from boresight.records.ledger import Entry

SIDE = 128


def field(rng: np.random.Generator, width_px: float) -> NDArray:
    """Correlated noise of unit variance."""
    side = SIDE + 2 * MARGIN + 16
    image = cv2.GaussianBlur(rng.standard_normal((side, side)).astype(np.float32), (0, 0), width_px)
    return image / image.std()


def dates(seed: int) -> tuple[NDArray, NDArray, NDArray]:
    """Template, window and offset (x, y), px, of lakes that rise and fall among fields of crops."""
    rng = np.random.default_rng([5, seed])
    basin, soil = field(rng, 7.0), field(rng, 3.0)
    one, two = (
        120.0
        - 60.0 / (1.0 + np.exp((0.7 + 0.1 * rng.standard_normal() - basin) / 0.1))
        + 6.0 * soil
        + 10.0 * field(rng, 2.0)
        + 10.0 * field(rng, 5.0)
        for _ in range(2)
    )
    x, y = 8 + MARGIN + rng.integers(-6, 7, 2)
    template, window = one[y : y + SIDE, x : x + SIDE], two[8:-8, 8:-8]
    return template.astype(np.float32), window.astype(np.float32), np.array([x, y]) - 8.0


@pytest.fixture(scope="module")
def outcomes() -> list[tuple[TemplateMatch | Entry, NDArray]]:
    return [(looked_for(t, w, SETTINGS), at) for t, w, at in map(dates, range(120))]


def test_chips_of_changed_ground_are_kept(outcomes: list):
    assert np.mean([bool(match) for match, _ in outcomes]) > 0.9


def test_errors_of_changed_ground_are_as_large_as_stated(outcomes: list):
    kept = [(m, m.xy_px - 0.5 * (SIDE - 1) - at) for m, at in outcomes if m]
    squares = [error @ np.linalg.solve(m.cov_px, error) for m, error in kept]
    assert (
        np.median([np.sqrt(np.trace(m.cov_px) / 2.0) for m, _ in kept]) > 0.1
    )  # px: of clean pairs a hundredth
    low, high = chi2(df=2 * len(kept)).ppf([0.0005, 0.9995])
    assert 0.7 * low < sum(squares) < 1.3 * high  # a third: covariances of few blocks are noisy themselves


def test_a_negative_is_found_where_its_positive_is():
    template, window, at = dates(3)
    match, other = (looked_for(template, picture, SETTINGS) for picture in (window, 300.0 - window))
    assert match and other
    assert other.xy_px == pytest.approx(match.xy_px, abs=3.0 * float(np.sqrt(np.trace(other.cov_px))))
    assert np.abs(other.xy_px - 0.5 * (SIDE - 1) - at).max() < 0.5  # px


def test_along_a_road_what_the_fit_cannot_reach_is_another_place():
    surface = 0.03 * np.random.default_rng(2).standard_normal((33, 33)).astype(np.float32)
    surface[16] = 0.5 + 0.02 * np.cos(np.arange(33) - 16.0)  # a ridge, highest in its middle
    peak = np.array([16.0, 16.0])
    assert probability_wrong(surface, peak) < 1e-4  # all of it is taken for the peak
    assert probability_wrong(surface, peak, 3) > 0.1


def test_pixels_that_are_not_valid_leave_the_edges_of_others_as_they_are():
    template, _, _ = dates(1)
    valid = np.ones(template.shape, dtype=bool)
    valid[40:70, 30:80] = False
    spoilt = np.where(valid, template, 900.0).astype(np.float32)
    edges = distinct_edges(spoilt, valid)
    whole = distinct_edges(template, np.ones_like(valid))
    assert not edges[:, ~valid].any()
    assert (
        np.abs(edges - whole)[:, :15].max() < 0.06
    )  # four sigma of the wide Gaussian away; the median moves
    assert np.hypot(*edges).max() < 2.0  # no edge where the hole begins


def cloudy(rng: np.random.Generator, window: NDArray, share: float) -> NDArray:
    """A window of which opaque clouds hide a share."""
    side = len(window)
    cover = field(rng, 15.0)[:side, :side]
    return np.where(cover > np.quantile(cover, 1.0 - share), 235.0, window).astype(np.float32)


def test_chips_under_clouds_are_kept_with_errors_as_stated():
    squares = []
    for seed in range(100, 120):
        template, window, at = dates(seed)
        match = looked_for(template, cloudy(np.random.default_rng(seed), window, 0.3), SETTINGS)
        if match:
            error = match.xy_px - 0.5 * (SIDE - 1) - at
            squares.append(error @ np.linalg.solve(match.cov_px, error))
    assert len(squares) >= 14
    assert np.mean(squares) < chi2(df=2 * len(squares)).ppf(0.9995) / len(squares)


def test_the_edge_of_one_cloud_is_no_agreement():
    rng = np.random.default_rng(9)
    template = rng.normal(size=(2, 96, 96)).astype(np.float32)
    picture = rng.normal(size=(2, 96, 96)).astype(np.float32)
    assert agreeing_parts(template, template) > 30.0  # all of 36
    assert agreeing_parts(template, picture) < 6.0
    picture[:] = 0.0
    picture[:, 40:50, 40:50] = template[:, 40:50, 40:50]
    assert agreeing_parts(template, picture) < 5.0
    assert agreeing_parts(template, -template) == 0.0


def test_windows_of_another_place_are_refused_under_clouds_too():
    kept = 0
    for seed in range(30):
        template, window = dates(seed)[0], dates(seed + 1000)[1]
        kept += bool(looked_for(template, cloudy(np.random.default_rng(seed), window, 0.6), SETTINGS))
    assert kept == 0
