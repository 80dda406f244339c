"""Stars of an exposure stand where astropy and OpenCV put them."""

import astropy.units as u
import cv2
import numpy as np
import pytest
from astropy.coordinates import GCRS, ITRS, CartesianRepresentation, Distance, SkyCoord
from astropy.time import Time
from scipy.optimize import least_squares

from boresight.geometry.earth_rotation import EarthRotation


def opencv_pixels(u_i, R_si, camera):
    """Pixels of apparent directions by OpenCV's projection, with Table 2's numbers by the errata's rule."""
    f_mm, f_px = camera.focal_mm, camera.focal_mm / camera.pixel_um * 1e3
    x0, y0 = camera.principal_px
    matrix = np.array([[f_px, 0, x0], [0, f_px, y0], [0, 0, 1.0]])
    k = np.array([camera.q1 * f_mm**2, camera.q2 * f_mm**4, camera.p2 * f_mm, camera.p1 * f_mm])
    ahead = R_si.apply(u_i) * [-1.0, -1.0, 1.0]  # OpenCV's x and y run along columns and rows
    return cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), matrix, k)[0][:, 0]


def astropy_directions(stars, mission, t_s):
    """Apparent directions by astropy, from the true orbit's own nodes."""
    o = mission.truth.orbit
    time = Time(mission.epoch.utc_from_seconds([t_s])[0].rstrip("Z"), scale="utc")
    nearest = int(np.argmin(np.abs(o.t_s - t_s)))
    dt = t_s - o.t_s[nearest]
    node_time = time - dt * u.s
    state = ITRS(CartesianRepresentation(o.positions_m[nearest] * u.m), obstime=node_time).transform_to(
        GCRS(obstime=node_time)
    )
    p = state.cartesian.xyz.to_value(u.m)
    # Velocity in GCRS from the nodes around, by differences of positions turned one by one.
    around = []
    for k in (nearest - 1, nearest + 1):
        at = time + (o.t_s[k] - t_s) * u.s
        around.append(
            ITRS(CartesianRepresentation(o.positions_m[k] * u.m), obstime=at)
            .transform_to(GCRS(obstime=at))
            .cartesian.xyz.to_value(u.m)
        )
    v = (around[1] - around[0]) / (o.t_s[nearest + 1] - o.t_s[nearest - 1])
    place = SkyCoord(
        ra=stars.ra_rad * u.rad,
        dec=stars.dec_rad * u.rad,
        pm_ra_cosdec=stars.pm_ra_rad_yr * np.cos(stars.dec_rad) * u.rad / u.yr,
        pm_dec=stars.pm_dec_rad_yr * u.rad / u.yr,
        distance=Distance(parallax=np.maximum(stars.parallax_arcsec, 1e-6) * u.arcsec),
        radial_velocity=np.zeros(len(stars.hip)) * u.km / u.s,
        obstime=Time(1991.25, format="jyear", scale="tt"),
    )
    frame = GCRS(
        obstime=time,
        obsgeoloc=CartesianRepresentation((p + dt * v) * u.m),
        obsgeovel=CartesianRepresentation(v * u.m / u.s),
    )
    seen = place.apply_space_motion(time).transform_to(frame)
    return seen.cartesian.xyz.value.T / np.linalg.norm(seen.cartesian.xyz.value, axis=0)[:, None]


@pytest.mark.filterwarnings("ignore")
def test_stars_stand_where_astropy_and_opencv_put_them(quiet_mission, stars):
    mission = quiet_mission
    exposure = mission.exposures[4]
    truth = mission.truth.exposure(exposure.exposure_id)
    known = truth.hip > 0
    chosen = stars.take(truth.hip[known] - 1)
    u_i = astropy_directions(chosen, mission, exposure.t_s)
    xy = opencv_pixels(u_i, truth.R_si, mission.scenario.star_camera)
    assert known.sum() > 50
    # 1 mas is 1.6e-5 px here. The mean over the smear's path differs from its middle by less than 1e-4 px.
    assert np.abs(xy - truth.xy_px[known]).max() < 2e-4  # px


def test_bright_stars_of_a_raw_image_lie_at_their_true_places(mission):
    exposure = mission.exposures[0]
    truth = mission.truth.exposure(exposure.exposure_id)
    image = exposure.image().astype(float)
    misses = []
    for n in np.argsort(truth.v_mag, kind="stable"):
        x, y = np.rint(truth.xy_px[n]).astype(int)
        apart = np.linalg.norm(truth.xy_px - truth.xy_px[n], axis=1)
        crowded = ((apart < 10.0) & (truth.v_mag < truth.v_mag[n] + 4.0)).sum() > 1
        if not (8 <= x < 1016 and 8 <= y < 760) or crowded or not 3.5 < truth.v_mag[n] < 6.0:
            continue
        part = image[y - 5 : y + 6, x - 5 : x + 6]
        fit = least_squares(
            lambda p, part=part: (gaussian(p) - part).ravel(), [0.0, 0.0, part.max(), 12.0, 1.0, 1.0]
        )
        misses.append(fit.x[:2] + np.array([x, y]) - truth.xy_px[n])
    misses = np.array(misses)
    assert len(misses) > 15
    # Signal to noise 30 and more at these magnitudes: errors of 0.03 px and less, 15 stars and more.
    assert np.abs(np.median(misses, axis=0)).max() < 0.02
    assert np.median(np.abs(misses)) < 0.04


def gaussian(p):
    """A Gaussian on a level, 11 x 11 pixels: x, y, height, level, width along columns and rows."""
    across = np.exp(-0.5 * ((np.arange(-5, 6) - p[0]) / p[4]) ** 2)
    return p[3] + p[2] * np.exp(-0.5 * ((np.arange(-5, 6) - p[1]) / p[5]) ** 2)[:, None] * across


def test_smear_follows_the_body_rate(mission, stars):
    scenario = mission.scenario.star_camera
    truth = [mission.truth.exposure(mission.exposures[n].exposure_id) for n in (4, 5)]
    turn = (truth[1].R_si * truth[0].R_si.inv()).magnitude()
    rate = turn * scenario.rate_hz  # rad/s
    # One turn in 95 minutes, less what yaw steering and the oscillation change.
    assert rate == pytest.approx(2.0 * np.pi / (95.1 * 60.0), rel=0.1)


def test_faint_stars_are_invented_beyond_the_catalogue(mission):
    truth = mission.truth.exposure("e0001")
    invented = truth.v_mag[truth.hip == 0]
    # 2 a square degree over a field of 18 x 14 degrees (252 square degrees): Poisson of 504, five sigma.
    assert abs(len(invented) - 504) < 112
    assert invented.min() >= 8.0
    assert invented.max() <= 10.0


def test_an_unknown_exposure_has_no_truth(mission):
    with pytest.raises(KeyError):
        mission.truth.exposure("e9999")


def test_attitude_is_nadir_pointing_with_the_offsets_asked_for(mission, tables):
    truth = mission.truth
    node = int(np.searchsorted(truth.orbit.t_s, truth.t_attitude_s[0]))
    t = truth.orbit.t_s[node]
    nearest = int(np.argmin(np.abs(truth.t_attitude_s - t)))
    earth = EarthRotation.over(mission.epoch, t, t, tables[0])
    up_i = earth.matrices_ie([t])[0] @ truth.orbit.positions_m[node]
    z_i = truth.R_ci[nearest].inv().apply([0.0, 0.0, 1.0])
    off_nadir = np.degrees(np.arccos(-z_i @ up_i / np.linalg.norm(up_i)))
    expected = np.degrees(np.arccos(np.cos(np.radians(7.0)) * np.cos(np.radians(2.0))))
    assert abs(truth.t_attitude_s[nearest] - t) < 2e-3
    assert off_nadir == pytest.approx(expected, abs=0.01)  # deg; the waves are 12 arcsec, 0.003 deg
