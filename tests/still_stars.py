"""Stars without motion, distance, brightness or colour, but for what is given."""

import numpy as np

from boresight.geometry.starlight import StarPlaces


def still_stars(ra_rad: np.ndarray, dec_rad: np.ndarray, **given: object) -> StarPlaces:
    """Stars numbered from 1, at J2000; `given` are fields of the record that differ from that."""
    motion = ("pm_ra_rad_yr", "pm_dec_rad_yr", "parallax_arcsec", "radial_velocity_km_s")
    plain = dict.fromkeys((*motion, "v_mag", "b_v"), np.zeros(len(ra_rad)))
    plain |= {"hip": np.arange(len(ra_rad)) + 1, "ra_rad": ra_rad, "dec_rad": dec_rad, "epoch_jyear": 2000.0}
    return StarPlaces(**plain | given)
