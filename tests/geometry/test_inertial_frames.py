"""Axes of EME2000 against skyfield and the bias angles of the IERS Conventions."""

import numpy as np
import pytest
from skyfield.framelib import ICRS_to_J2000

from boresight.geometry.constants import ARCSEC
from boresight.geometry.earth_rotation import rotation_to_gcrs


def test_frame_bias_is_that_of_skyfield_and_of_the_conventions():
    bias = rotation_to_gcrs("EME2000").inv().as_matrix()
    # skyfield rounds the pole offset to 0.1 µas, 7e-13 rad
    assert np.abs(bias - ICRS_to_J2000).max() < 1e-12
    # IERS Conventions 2010, 5.4.4: pole offsets -16.6170 mas and -6.8192 mas, equinox -14.6 mas
    assert bias[2, 0] / ARCSEC == pytest.approx(-0.0166170, abs=2e-7)  # arc-seconds
    assert bias[2, 1] / ARCSEC == pytest.approx(-0.0068192, abs=2e-7)
    assert bias[0, 1] / ARCSEC == pytest.approx(-0.0146, abs=2e-7)


@pytest.mark.parametrize("frame", ["GCRF", "ICRF"])
def test_the_axes_of_icrf_are_those_of_gcrs(frame):
    assert rotation_to_gcrs(frame).magnitude() == 0.0
