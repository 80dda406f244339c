"""Which stars an exposure shows, where on the detector, and how they move while it lasts."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.geometry.geodesy import unit_vectors
from boresight.geometry.orbit import Orbit
from boresight.geometry.star_camera import StarCamera
from boresight.geometry.starlight import StarPlaces, apparent_star_directions
from boresight.records.record import array, record, scalar
from boresight.simulator.mission_records import TrueExposure
from boresight.simulator.motion import ScanAttitude, TrueAttitude
from boresight.simulator.scenario import SkySettings
from boresight.simulator.sky import expose, star_charge

__all__ = ["StarField", "with_invented_stars"]

Array = NDArray[np.float64]

# Area of the sky, square degrees.
_SPHERE_DEG2 = 4.0 * np.pi * np.degrees(1.0) ** 2
_MARGIN_PX = 40.0  # stars so far outside still shed light on the detector's edge


@record(kw_only=True)
class StarField:
    """The sky in front of a star camera: everything needed to render its exposures."""

    camera: StarCamera = scalar("star camera")
    sky: SkySettings = scalar("settings of the sky and the detector")
    stars: StarPlaces = scalar("catalogue stars and invented ones")
    orbit: Orbit = scalar("true orbit")
    attitude: TrueAttitude | ScanAttitude = scalar("true attitude")
    hot: Array = array("M, 3", "from `simulator.sky.hot_pixels`")

    def paths(self, t_s: float, exposure_s: float) -> tuple[StarPlaces, Array]:
        """The stars that reach the detector, and where they stand at evenly shared instants: (N, K, 2) px."""
        boresight_i = self.attitude.R_si([t_s]).inv().apply([0.0, 0.0, 1.0])[0]
        # aberration and space motion move stars by less
        radius = self.camera.field_radius_rad + np.radians(0.5)
        stars = self.stars.take(_catalogue_i(self.stars) @ boresight_i > np.cos(radius))
        p_i, v_i = self.orbit.states_i([t_s])
        u_i = apparent_star_directions(stars, self.orbit.epoch, t_s, p_i[0], v_i[0])
        rough = self._pixels(u_i, t_s + exposure_s * np.array([-0.5, 0.5]))
        smear_px = float(np.nanmax(np.abs(rough[:, 1] - rough[:, 0]), initial=0.0))
        steps = max(2, int(np.ceil(smear_px * self.sky.sub_exposures_per_px)))
        paths = self._pixels(u_i, t_s + exposure_s * ((np.arange(steps) + 0.5) / steps - 0.5))
        size = np.array([self.camera.width_px, self.camera.height_px])
        centre = paths.mean(axis=1)
        near = ((centre > -_MARGIN_PX) & (centre < size + _MARGIN_PX)).all(axis=1)
        return stars.take(near), paths[near]

    def image(self, t_s: float, exposure_s: float, rng: np.random.Generator) -> NDArray[Any]:
        """The raw image (height, width) of an exposure whose middle is `t_s`."""
        stars, paths = self.paths(t_s, exposure_s)
        charge = star_charge(stars.v_mag, stars.b_v, exposure_s, self.sky)
        size = (self.camera.width_px, self.camera.height_px)
        return expose(paths, charge, size, self.sky, self.hot, rng)

    def truth(self, exposure_id: str, t_s: float, exposure_s: float) -> TrueExposure:
        """True positions of that image's stars."""
        stars, paths = self.paths(t_s, exposure_s)
        inside = self.camera.contains(paths.mean(axis=1))
        stars, paths = stars.take(inside), paths[inside]
        return TrueExposure(
            exposure_id=exposure_id,
            t_s=t_s,
            R_si=self.attitude.R_si([t_s])[0],
            hip=stars.hip,
            xy_px=paths.mean(axis=1),
            v_mag=stars.v_mag,
        )

    def _pixels(self, u_i: Array, instants: Array) -> Array:
        """(N, T, 2) image points of apparent directions, whose aberration stays the same meanwhile."""
        turns = self.attitude.R_si(instants)
        return np.stack([self.camera.pixels_from_directions(turn.apply(u_i)) for turn in turns], axis=1)


@lru_cache(maxsize=1)  # every exposure asks
def _catalogue_i(stars: StarPlaces) -> Array:
    """Catalogue positions (N, 3) as unit vectors, for a coarse selection."""
    return unit_vectors(stars.ra_rad, stars.dec_rad)


def with_invented_stars(stars: StarPlaces, sky: SkySettings, rng: np.random.Generator) -> StarPlaces:
    """The catalogue and faint stars that no catalogue lists (`hip` 0), evenly over the sky.

    Their number grows by the factor 10^0.45 a magnitude, as in the real sky away from the Milky Way.
    """
    count = rng.poisson(sky.faint_stars_per_deg2 * _SPHERE_DEG2)
    low, high = (10.0 ** (0.45 * v) for v in sky.faint_v_range)
    invented = StarPlaces.uncatalogued(
        ra_rad=rng.uniform(0.0, 2.0 * np.pi, count),
        dec_rad=np.arcsin(rng.uniform(-1.0, 1.0, count)),
        v_mag=np.log10(rng.uniform(low, high, count)) / 0.45,
        epoch_jyear=stars.epoch_jyear,
    )
    return StarPlaces.together([stars, invented])
