"""Pairs of which more has changed than is common: kept, with errors as stated, whatever their contrast."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from test_locate import MARGIN, SETTINGS, looked_for

from boresight.gct_match.imaging.views import band_passed, view_of
from boresight.gct_match.records import TemplateMatch
from boresight.gct_match.search.correlation import probability_wrong
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
    return [(looked_for(t, w, SETTINGS), at) for t, w, at in map(dates, range(40))]


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
    assert probability_wrong([surface], peak) < 1e-4  # all of it is taken for the peak
    assert probability_wrong([surface], peak, 3) > 0.1


def test_pixels_that_are_not_valid_leave_the_band_of_others_as_it_is():
    template, _, _ = dates(1)
    valid = np.ones(template.shape, dtype=bool)
    valid[40:70, 30:80] = False
    spoilt = np.where(valid, template, 900.0).astype(np.float32)
    band = band_passed(view_of(spoilt, valid)).normalised
    whole = band_passed(view_of(template, np.ones_like(valid))).normalised
    assert not band[~valid].any()
    assert np.abs(band - whole)[:20].max() < 0.1  # grey values of 60: four sigma of the wide Gaussian away
    assert np.abs(band).max() < 2.0 * np.abs(whole).max()  # no edge where the hole begins
