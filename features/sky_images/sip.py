"""World coordinates of FITS for a star image: tangent-plane projection with SIP polynomials (Shupe et al.
2005).

The principal point is the reference pixel and the optical axis the reference direction, so the linear part is
a rotation and a scale, and the polynomials are the distortion alone.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.star_camera import StarCamera
from boresight.records.record import Floats, array, record, scalar

__all__ = ["TanSip", "tan_sip"]

_ORDER = 7  # of the polynomials


@record(kw_only=True)
class TanSip:
    """Keywords of a TAN-SIP header. In FITS the centre of the first pixel is (1, 1)."""

    crval_deg: tuple[float, float] = scalar("right ascension and declination of the reference pixel, deg")
    crpix: tuple[float, float] = scalar("reference pixel")
    cd: Floats = array("2, 2", "deg per pixel")
    a: Floats = array("P, P", "A_p_q in a[p, q]: corrected u = u + sum A_p_q u^p v^q")
    b: Floats = array("P, P", "B_p_q in b[p, q]: corrected v = v + sum B_p_q u^p v^q")
    largest_misfit_px: float = scalar("of the polynomials against the camera, over the detector, px")

    def cards(self) -> dict[str, float | int | str]:
        """Header keywords and values, in order."""
        order = len(self.a) - 1
        cards: dict[str, float | int | str] = {"CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP"}
        cards |= zip(("CRVAL1", "CRVAL2", "CRPIX1", "CRPIX2"), (*self.crval_deg, *self.crpix))
        cards |= zip(("CD1_1", "CD1_2", "CD2_1", "CD2_2"), map(float, self.cd.ravel()))
        cards |= {"A_ORDER": order, "B_ORDER": order}
        for name, table in (("A", self.a), ("B", self.b)):
            for p, q in zip(*np.nonzero(table)):
                cards[f"{name}_{p}_{q}"] = float(table[p, q])
        return cards


def tan_sip(
    camera: StarCamera,
    R_si: Rotation,
    *,
    sky_of: Callable[[Floats], Floats] = lambda u_i: u_i,
    mirrored: bool = False,
) -> TanSip:
    """TAN-SIP header, polynomials of order 7, of an image taken by `camera` with attitude `R_si`.

    `sky_of` takes observed directions (N, 3) to those of the catalogue; `mirrored`: camera and attitude are
    those of the image with its columns reversed. Where a part of the detector has no direction (corners
    behind a fisheye), the misfit is infinite.
    """
    x, y = np.meshgrid(np.linspace(0, camera.width_px - 1, 41), np.linspace(0, camera.height_px - 1, 31))
    every = np.column_stack([x.ravel(), y.ravel()])
    xy = every[np.isfinite(camera.directions_from_pixels(every)[:, 2])]
    to_sky = R_si.inv()
    sky_i = sky_of(to_sky.apply(camera.directions_from_pixels(xy)))
    axis_s = R_si.apply(sky_of(to_sky.apply(np.array([[0.0, 0.0, 1.0]]))))[0]
    R_si = Rotation.from_rotvec(np.cross(axis_s, [0.0, 0.0, 1.0])) * R_si  # aberration at the axis
    u_s = R_si.apply(sky_i)
    focal_px = camera.focal_m / camera.pixel_m
    flip = np.array([-1.0 if mirrored else 1.0, 1.0])
    offset = flip * (xy - np.asarray(camera.principal_px))
    ideal = flip * (-u_s[:, :2] / u_s[:, 2:] * focal_px)
    powers = [(p, q) for p in range(_ORDER + 1) for q in range(_ORDER + 1 - p) if p + q >= 1]
    unit = float(np.abs(offset).max())
    scaled = offset / unit
    A = np.stack([scaled[:, 0] ** p * scaled[:, 1] ** q for p, q in powers], axis=1)
    fit = np.linalg.lstsq(A, ideal - offset, rcond=None)[0]
    misfit = float(np.abs(A @ fit - (ideal - offset)).max()) if len(xy) == len(every) else np.inf
    a, b = np.zeros((2, _ORDER + 1, _ORDER + 1))
    for (p, q), (dx, dy) in zip(powers, fit):
        a[p, q], b[p, q] = dx / unit ** (p + q), dy / unit ** (p + q)
    axes_i = R_si.inv().apply(np.eye(3))
    ra, dec = np.arctan2(axes_i[2, 1], axes_i[2, 0]), np.arcsin(axes_i[2, 2])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    cd = -flip * np.degrees(np.array([axes_i[:2] @ east, axes_i[:2] @ north]) / focal_px)
    x0, y0 = camera.principal_px
    x0 = camera.width_px - 1.0 - x0 if mirrored else x0
    crval = (float(np.degrees(ra) % 360.0), float(np.degrees(dec)))
    return TanSip(crval_deg=crval, crpix=(x0 + 1.0, y0 + 1.0), cd=cd, a=a, b=b, largest_misfit_px=misfit)
