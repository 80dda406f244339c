"""The table of centroids, read back bit for bit."""

import io
from dataclasses import replace

import numpy as np
from astropy.io import fits
from orbiting_camera import NOTES
from pytest import approx

from boresight.features.exports.star_fits import centroids_fits
from boresight.geometry.epoch import Epoch
from boresight.geometry.sightings import StarSightings, isotropic_covariance
from boresight.star_id.catalogue import hipparcos_stars

EPOCH = Epoch.from_utc("2025-03-20T02:31:07Z")


def exposure(name, t_s, n):
    rng = np.random.default_rng(n)
    u = rng.normal(size=(n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    covariance = isotropic_covariance(u, 3e-6)
    rows = {"hip": 11000 + np.arange(n), "xy_px": rng.uniform(0, 500, (n, 2)), "u_s": u, "u_i": -u}
    return StarSightings(exposure_id=name, t_s=t_s, **rows, cov_s=covariance)


def read_back(content):
    """Header and rows of the table of a FITS file that keeps to the standard."""
    with fits.open(io.BytesIO(content)) as file:
        file.verify("exception")
        return file[1].header, np.array(file[1].data)


def test_every_star_is_read_back_bit_for_bit():
    first = replace(exposure("E0001", 0.25, 4), snr=10.0 * np.arange(4))
    exposures = [first, exposure("E0002", 0.45, 3)]
    content = centroids_fits(exposures, EPOCH, replace(NOTES, mission="mission ü"))
    cards, table = read_back(content)
    assert (cards["XTENSION"], cards["TIMESYS"], cards["TFIELDS"]) == ("BINTABLE", "UTC", 11)
    assert (cards["RADESYS"], cards["DATE"]) == ("ICRS", "2026-01-01T00:00:00")
    assert len(table) == 7
    assert table["EXPOSURE"].tolist() == [b"E0001"] * 4 + [b"E0002"] * 3
    assert table["UTC"][0] == b"2025-03-20T02:31:07.250000000"
    for name, key in (("HIP", "hip"), ("XY", "xy_px"), ("U_S", "u_s"), ("U_I", "u_i")):
        assert np.array_equal(table[name], np.concatenate([getattr(e, key) for e in exposures]))
    u_i = np.concatenate([e.u_i for e in exposures])
    ra, dec = np.radians(table["RA"]), np.radians(table["DEC"])
    again = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    assert again == approx(u_i, abs=1e-15)
    assert table["SIGMA"] == approx(3e-6, rel=1e-12)  # rad
    assert table["SNR"].tolist()[:4] == [0.0, 10.0, 20.0, 30.0] and np.isnan(table["SNR"][4:]).all()
    # ESA 1997, main catalogue: HIP 11000 to 11003; NaN beyond V = 8.
    places = hipparcos_stars(8.0).places
    known = {int(hip): v for hip, v in zip(places.hip, places.v_mag)}
    expected = [known.get(hip, np.nan) for hip in table["HIP"].tolist()]
    assert np.array_equal(table["VMAG"], expected, equal_nan=True) and np.isfinite(expected).any()


def test_no_exposures_give_an_empty_table():
    assert len(read_back(centroids_fits([], EPOCH, NOTES))[1]) == 0


def test_a_long_name_of_a_mission_fills_its_card_and_no_more():
    notes = replace(NOTES, mission="m" * 60 + "0123456789")
    cards, _ = read_back(centroids_fits([exposure("e1", 1.0, 3)], EPOCH, notes))
    assert cards["MISSION"] == "m" * 60 + "01234567"  # 68 characters fit between the quotes
