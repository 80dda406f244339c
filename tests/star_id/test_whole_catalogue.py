"""All of Hipparcos against the numbers that its makers published, and against the V 8 subset."""

import numpy as np
import pytest
from pytest import approx

from boresight.geometry.constants import ARCSEC
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.whole_catalogue import all_hipparcos

MAS = 1e-3 * ARCSEC
# CDS I/311 (hip2.dat): RA, Dec (rad at J1991.25), parallax (mas), mu_alpha cos(delta), mu_delta (mas/yr) and
# the errors of RA, Dec (mas) and of the motions (mas/yr). HIP 1: Hp 9.2043, B-V 0.482, V 9.10 in ESA 1997.
PUBLISHED = {
    1: (0.0000159148, 0.0190068680, 4.55, -4.55, -1.19, 1.29, 0.66, 1.25, 0.75),
    2: (0.0000662767, -0.3403189126, 20.85, 182.88, -1.31, 0.95, 0.53, 1.22, 0.66),
    3: (0.0000874051, 0.6782224871, 2.26, 4.27, -3.43, 0.31, 0.21, 0.34, 0.27),
}


@pytest.mark.parametrize("hip", PUBLISHED)
def test_stars_are_those_of_the_published_table(hip):
    ra, dec, parallax, pm_ra, pm_dec, e_ra, e_dec, e_pm_ra, e_pm_dec = PUBLISHED[hip]
    stars = all_hipparcos()
    star = stars.take(np.flatnonzero(stars.places.hip == hip))
    # half a step of the whole numbers in the file: 0.15 mas, 0.05 mas/yr
    assert star.places.ra_rad[0] == approx(ra, abs=0.16 * MAS)
    assert star.places.dec_rad[0] == approx(dec, abs=0.16 * MAS)
    assert star.places.parallax_arcsec[0] * 1e3 == approx(parallax, abs=0.051)
    assert star.places.pm_ra_rad_yr[0] * np.cos(dec) / MAS == approx(pm_ra, abs=0.051)
    assert star.places.pm_dec_rad_yr[0] / MAS == approx(pm_dec, abs=0.051)
    for got, a, b in ((star.sigma_rad, e_ra, e_dec), (star.sigma_pm_rad_yr, e_pm_ra, e_pm_dec)):
        stated = np.hypot(a, b) / np.sqrt(2.0)
        assert stated <= got[0] / MAS * (1 + 1e-12) and got[0] / MAS <= stated * 2.0 ** (1 / 16)
    years = 2026.0 - 1991.25
    expected = np.hypot(star.sigma_rad, years * star.sigma_pm_rad_yr)
    assert star.sigma_at_rad(2026.0) == approx(expected)


def test_it_holds_every_star_of_the_new_reduction_once_and_agrees_with_the_v_8_subset():
    stars, bright = all_hipparcos(), hipparcos_stars(8.0)
    assert len(stars.places.hip) == 117_955
    assert np.all(np.diff(stars.places.hip) > 0)
    assert stars.places.v_mag[0] == approx(9.10, abs=0.02)  # V from Hp and B-V
    _, row, its_row = np.intersect1d(stars.places.hip, bright.places.hip, return_indices=True)
    use = bright.solved[its_row]
    for name, limit in (("ra_rad", 0.2 * MAS), ("dec_rad", 0.2 * MAS), ("v_mag", 0.0051)):
        difference = getattr(stars.places, name)[row] - getattr(bright.places, name)[its_row]
        assert np.abs(difference[use]).max() < limit, name
    assert 0.8 < stars.single.mean() < 0.9
