"""Stars found in strips of noise, and what else is not one."""

import numpy as np
import pytest
from strip_frames import Strip, noise_strip, trace

from boresight.star_id.strip_stars.column_blocks import column_levels
from boresight.star_id.strip_stars.find import StripMotion, find_strip_stars
from boresight.star_id.strip_stars.settings import StripStarSettings

MATCHED = StripMotion(np.array([0.0, 1500.0]), np.ones((2, 2)), np.zeros((2, 2)), 1)


def found_in(strip, **changes):
    return find_strip_stars(strip, MATCHED, StripStarSettings(**changes), 255.0)


def test_stars_are_found_once_each_where_they_cross_also_at_the_seams_of_blocks():
    rng = np.random.default_rng(2)
    lines = [255.6, 256.4, 1023.5, 1024.4, 400.2, 700.7, 900.1, 1300.9]
    stars = [(n % 2, 30.3 + 41.0 * n, y, 60.0 + 40.0 * n) for n, y in enumerate(lines)]
    found = found_in(noise_strip(rng, hot=6, stars=stars), false_alarms_per_strip=0.01)
    assert len(found.ccd) == len(stars)
    for ccd, x, y, charge in stars:
        miss = np.where(found.ccd == ccd, np.hypot(*(found.xy_px - (x, y)).T), np.inf)
        k = int(miss.argmin())
        sigma = np.sqrt(np.trace(found.cov_px[k]))
        assert miss[k] < 4.0 * sigma and sigma < 0.2
        assert abs(found.flux_dn[k] - charge) < 5.0 * charge / found.snr[k]


@pytest.mark.parametrize("hot", [0, 12])
def test_hot_columns_are_no_stars_and_false_alarms_are_as_many_as_asked_for(hot):
    rng, strips, asked = np.random.default_rng(3), 16, 10.0
    strip = [noise_strip(rng, hot=hot) for _ in range(strips)]
    count = np.mean([len(found_in(one, false_alarms_per_strip=asked).ccd) for one in strip])
    # 0.8 is the standard error of the mean; the fit finds some maxima only near their pixel's peak
    assert 0.5 * asked < count < asked + 3.0 * np.sqrt(asked / strips), count


def test_stars_are_found_as_often_at_the_corner_of_four_pixels_as_in_the_middle_of_one():
    rng, shares = np.random.default_rng(9), []
    for at in (0.0, 0.5):
        image = trace(at, at, 1.0, 0.0, 1, 0.55, 8)
        charge = 6.5 * 0.95 / np.sqrt((image**2).sum())  # SNR 6.5 in noise of 0.95 DN
        stars = [
            (ccd, 20.0 + 24 * i + 5 * j % 24 + at, 20.0 + 24 * j + at, charge)
            for ccd in (0, 1)
            for i in range(14)
            for j in range(60)
        ]
        found = found_in(noise_strip(rng, stars=stars), psf_sigma_px=0.55, gain_e_per_dn=60.0)
        shares.append(len(found.ccd) / len(stars))
    # 0.01 is the standard error of the difference of two shares of 1680 stars
    assert abs(shares[0] - shares[1]) < 0.04 and min(shares) > 0.8, shares


def test_hits_of_one_row_are_told_from_stars_by_their_shape():
    rng = np.random.default_rng(4)
    strip = noise_strip(rng)
    for n in range(6):
        strip.images[0][100 + 200 * n, 40 + 50 * n] = 200
    found = found_in(strip, psf_sigma_px=0.55, gain_e_per_dn=60.0, false_alarms_per_strip=1e-3)
    assert len(found.ccd) == 0 and found.misshapen == 6


def test_a_double_star_is_marked_as_blended_and_a_saturated_one_as_saturated():
    rng = np.random.default_rng(6)
    double = [(0, 100.0, 300.0, 300.0), (0, 104.0, 302.5, 150.0)]
    stars = [*double, (1, 200.3, 800.2, 3000.0), (1, 60.0, 90.0, 300.0)]
    found = found_in(noise_strip(rng, stars=stars), psf_sigma_px=0.55, false_alarms_per_strip=0.01)
    by_place = {
        round(float(x)): (bool(b), bool(s))
        for (x, _), b, s in zip(found.xy_px, found.blended, found.saturated)
    }
    by_place.pop(104, None)  # beside a star of twice its light it may be no star's trace
    assert by_place == {100: (True, False), 200: (False, True), 60: (False, False)}


def test_a_star_whose_middle_is_beside_the_detector_is_not_listed():
    rng, edge = np.random.default_rng(7), 20
    stars = [(0, edge - 0.9, 200.0, 400.0), (0, edge + 0.3, 700.0, 400.0), (1, edge - 0.8, 400.0, 900.0)]
    whole = noise_strip(rng, stars=stars)
    seen = Strip({ccd: np.ascontiguousarray(image[:, edge:]) for ccd, image in whole.images.items()})
    found = found_in(seen, psf_sigma_px=0.55, gain_e_per_dn=60.0, false_alarms_per_strip=0.01)
    assert [round(float(y)) for y in found.xy_px[:, 1]] == [700]
    assert abs(found.xy_px[0, 0] - 0.3) < 4.0 * np.sqrt(found.cov_px[0, 0, 0])


def test_light_of_six_sigmas_is_not_of_a_column_s_level_and_that_of_two_and_a_half_is():
    # 8000 rows: 0.05 sigma and 5 % are more than four standard errors of a mean and of a standard deviation
    level, sigma = np.linspace(90.0, 250.0, 9), np.linspace(6.0, 14.0, 9)
    block = np.random.default_rng(14).normal(level, sigma, (8000, 9))
    block[7::20, 1] = level[1] + 6.5 * sigma[1]
    block[7::20, 6] = level[6] + 2.5 * sigma[6]
    found = column_levels(np.rint(block).astype(np.uint16))
    expected = level.copy()
    expected[6] += 2.5 * sigma[6] / 20.0
    assert (np.abs(found.level_dn - expected) / sigma).max() < 0.05
    assert np.delete(found.noise_dn / sigma, 6) == pytest.approx(1.0, abs=0.05)
