"""A wrong star camera is found in its stars, with its size, and with what it does to the attitudes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.calib.star_camera_error import PARTS, star_effects, summed
from boresight.geometry.attitude_estimate import AttitudeSettings, with_attitudes
from boresight.geometry.constants import ARCSEC
from boresight.geometry.sightings import StarSightings, StripSightings, isotropic_covariance
from boresight.geometry.star_camera import StarCamera
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips

CAMERA = StarCamera(
    focal_m=0.1, pixel_m=1.5e-5, width_px=1024, height_px=768, principal_px=(515.3, 380.2), q1=2e-6
)
LIMIT = 13.8  # chi-square of 2 degrees of freedom, probability 1e-3
(DRAWN,) = draw_strips(
    StripPlan(strips=1, exposures=6, targets=2), CameraPair(Rotation.identity()), np.random.default_rng(1)
)[0]


def seen(camera: StarCamera, sigma_px: float = 0.02) -> StripSightings:
    """Six exposures whose stars `camera` saw, and CAMERA gave directions to."""
    rng, exposures = np.random.default_rng(5), []
    for exposure in DRAWN.exposures:
        R = Rotation.from_rotvec(rng.normal(0.0, 1.0, 3))
        xy = rng.uniform([20.0, 20.0], [1000.0, 740.0], (60, 2))
        u_i = R.inv().apply(camera.directions_from_pixels(xy))
        xy = xy + rng.normal(0.0, sigma_px, xy.shape)
        u_s = CAMERA.directions_from_pixels(xy)
        sigma = np.full(len(xy), sigma_px * CAMERA.pixel_m / CAMERA.focal_m)
        exposures.append(
            StarSightings(
                exposure_id=exposure.exposure_id,
                t_s=exposure.t_s,
                hip=np.arange(len(xy)),
                xy_px=xy,
                u_s=u_s,
                u_i=u_i,
                cov_s=isotropic_covariance(u_s, sigma),
            )
        )
    return with_attitudes([replace(DRAWN, exposures=tuple(exposures))], AttitudeSettings())[0]


def sizes(strip: StripSightings) -> tuple[np.ndarray, np.ndarray]:
    """Each part by itself: its size and its chi-square."""
    information, right = summed(star_effects([strip], CAMERA, LIMIT))
    own = np.diag(information)
    return right / own, right**2 / own


# Stated less true; the corner of the detector is 640 px = 9.6 mm from its middle, where q1 moves a star by
# q1 r³ = 5e-5 * 9.6³ mm = 44 µm, or 2.9 px.
@pytest.mark.parametrize(
    ("true", "part", "size"),
    [
        (replace(CAMERA, focal_m=0.0999), "focal length", 0.1),
        (replace(CAMERA, principal_px=(527.3, 380.2)), "principal point, column", -12.0),
        (replace(CAMERA, principal_px=(515.3, 368.2)), "principal point, row", 12.0),
        (replace(CAMERA, q1=5.2e-5), "radial distortion", -2.9),
        # p2 r² = 1e-4 * 9.6² mm = 9.2 µm, or 0.61 px
        (replace(CAMERA, p1=1e-4), "decentring, column", -0.61),
        (replace(CAMERA, p2=-1e-4), "decentring, row", 0.61),
    ],
)
def test_the_part_that_is_wrong_explains_most_and_has_its_size(true, part, size) -> None:
    found, gain = (dict(zip(PARTS, values)) for values in sizes(seen(true)))
    assert max(gain, key=gain.__getitem__) == part and gain[part] > 100.0
    # to a tenth: the columns leave out the lens' distortion
    assert found[part] == pytest.approx(size, rel=0.1)


def test_a_right_camera_is_not_accused() -> None:
    _, gain = sizes(seen(CAMERA))
    assert gain.max() < 16.0  # chi-square of 1, probability 6e-5, four times


def test_a_wrong_principal_point_turns_the_attitude_by_its_angle() -> None:
    (effects,) = star_effects([seen(CAMERA)], CAMERA, LIMIT)
    turned = np.linalg.norm(effects.psi[:, :, PARTS.index("principal point, column")], axis=1)
    assert turned == pytest.approx(np.full(6, CAMERA.pixel_m / CAMERA.focal_m), rel=0.05)
    assert turned[0] / ARCSEC == pytest.approx(30.9, rel=0.05)  # arcsec a pixel
