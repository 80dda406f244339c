"""Raw strips of the sky: where stars cross the line detectors, and the image that each leaves.

A star's image is a Gaussian of the optics. A row collects, in each TDI stage, the light that falls on a pixel
in one row period; the charge moves on by one stage a row, towards +x of the focal plane. The image point's
true path (rate, waves, vibration) is followed while the star crosses, so that a rate that does not match the
rows, a drift and jitter smear it. Frames: i = GCRS, c = remote-sensing camera. Charges are electrons.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from boresight.geometry.geodesy import unit_vectors
from boresight.geometry.line_camera import LineCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import RowClock
from boresight.geometry.starlight import StarPlaces, SurveyedStars, apparent_star_directions
from boresight.records.record import record, scalar
from boresight.simulator.mission_records import TrueStar
from boresight.simulator.motion import ScanAttitude
from boresight.simulator.scan import all_panels, digitised_strip, panels_near
from boresight.simulator.scenario import GroundSettings, SkyStripSettings

__all__ = ["SkyScene", "hot_columns", "sky_around", "sky_strip"]

Array = NDArray[np.float64]
Grey = NDArray[np.float32]

# Steps of finding the instant at which a star crosses a row (set by hand).
_CROSSING_STEPS = 8
_REACH_SIGMA = 6.0  # beyond it 2e-9 of the light is lost
_STEPS_A_ROW = 8  # in which a row's exposure is divided
_BEYOND_LINES = 400.0  # stars that cross so far outside a strip still shed light on it, smeared by TDI
# Distance, px, beside the detector from which a star is no longer rendered: its light does not reach it.
_BESIDE_PX = 20.0
_LISTED_BESIDE_PX = 1.5  # from the middle of the last pixel


@record(kw_only=True)
class SkyScene:
    """One scan as it truly is: everything needed to render its strip."""

    strip_id: str = scalar("id of the strip")
    camera: LineCamera = scalar("with the residual of the distortion table")
    attitude: ScanAttitude = scalar("true attitude")
    orbit: Orbit = scalar("true orbit")
    rows: RowClock = scalar("true times of the rows' middles")
    settings: SkyStripSettings = scalar("sky, optics and detector")
    rate: float = scalar("pixels a row")
    stars: StarPlaces = scalar("true places of the stars around the scan")

    def crossings(self, ccd: int) -> tuple[StarPlaces, Array]:
        """Stars (N,) that cross a CCD during the strip, and where, (N, 2): sample and line."""
        lines = self.settings.lines
        line: Array = np.full(len(self.stars.hip), 0.5 * lines, dtype=np.float64)
        u_i = self._apparent(self.stars, line)
        for step in range(_CROSSING_STEPS):
            sample, across = self._places(ccd, u_i, line)
            line = np.clip(line + across / self.rate, -_BEYOND_LINES, lines + _BEYOND_LINES)
            if step == _CROSSING_STEPS // 2:
                u_i = self._apparent(self.stars, line)
        size = np.array([self.camera.n_px(ccd), lines])
        off = np.abs(np.column_stack([sample, line]) - 0.5 * (size - 1.0)) - 0.5 * size
        inside = np.flatnonzero((off < [_BESIDE_PX, 0.5 * _BEYOND_LINES]).all(axis=1))
        return self.stars.take(inside), np.column_stack([sample, line])[inside]

    def truth(self) -> tuple[TrueStar, ...]:
        """Stars whose middle lies in the image of some CCD, or so near that its measured place may."""
        found = []
        for ccd in range(self.camera.n_ccds):
            stars, places = self.crossings(ccd)
            charge = self._charge(stars)
            last = np.array([self.camera.n_px(ccd), self.settings.lines]) - 1.0
            for k, (sample, line) in enumerate(places.tolist()):
                if (np.abs(places[k] - 0.5 * last) <= 0.5 * last + _LISTED_BESIDE_PX).all():
                    row = (sample, line, float(charge[k]), float(stars.v_mag[k]))
                    found.append(TrueStar(self.strip_id, ccd, int(stars.hip[k]), *row))
        return tuple(found)

    def images(self, ccd: int) -> Iterator[tuple[int, int, Array]]:
        """First row, first sample and electrons (rows, samples) of each star's image."""
        stars, places = self.crossings(ccd)
        for k, electrons in enumerate(self._charge(stars)):
            yield self._image(ccd, stars.take(np.array([k])), places[k], float(electrons))

    def _charge(self, stars: StarPlaces) -> Array:
        per_row = self.settings.flux_v0_e_per_s * self.rows.row_period_s * 10.0 ** (-0.4 * stars.v_mag)
        return per_row * self.camera.tdi_stages / abs(self.rate)

    def _image(self, ccd: int, star: StarPlaces, place: Array, charge_e: float) -> tuple[int, int, Array]:
        stages, sigma = self.camera.tdi_stages, self.settings.psf_sigma_px
        reach = (_REACH_SIGMA * sigma + 1.0 + 0.5 * stages * abs(1.0 - self.rate)) / abs(self.rate) + 1.0
        first, last = int(np.floor(place[1] - reach)), int(np.ceil(place[1] + reach))
        u_i = self._apparent(star, place[1:])
        nodes: Array = np.arange(first - stages, last + stages + 1.0, dtype=np.float64)
        sample, across = self._places(ccd, np.repeat(u_i, len(nodes), axis=0), nodes)
        stage = np.arange(stages) - 0.5 * (stages - 1.0)
        part = (np.arange(_STEPS_A_ROW) + 0.5) / _STEPS_A_ROW - 0.5
        rows = np.arange(first, last + 1)
        t = rows[:, None, None] + stage[:, None] + part  # in rows: (K, stages, parts)
        along = np.interp(t, nodes, -across) - stage[:, None]
        beside = np.interp(t, nodes, sample)
        width = int(np.ceil(_REACH_SIGMA * sigma + 1.0 + np.ptp(beside)))
        left = int(np.rint(place[0])) - width
        edges = left - 0.5 + np.arange(2 * width + 2)
        share = ndtr((along + 0.5) / sigma) - ndtr((along - 0.5) / sigma)
        columns = np.diff(ndtr((edges - beside[..., None]) / sigma), axis=-1)
        light = charge_e * abs(self.rate) / (stages * _STEPS_A_ROW)  # electrons of one part of one stage
        return first, left, light * np.einsum("kjq,kjqn->kn", share, columns)

    def _apparent(self, stars: StarPlaces, line: Array) -> Array:
        t_s = self.rows.instant(line)
        return apparent_star_directions(stars, self.orbit.epoch, t_s, *self.orbit.states_i(t_s))

    def _places(self, ccd: int, u_i: Array, line: Array) -> tuple[Array, Array]:
        """Sample and distance across (N,) of directions (N, 3) at lines (N,)."""
        u_c = self.attitude.R_ci(self.rows.instant(line)).apply(u_i)
        return self.camera.samples_from_directions(ccd, u_c)


def sky_around(
    survey: SurveyedStars,
    attitude: ScanAttitude,
    radius_rad: float,
    settings: SkyStripSettings,
    orbit: Orbit,
    rng: np.random.Generator,
) -> StarPlaces:
    """True places of the stars within `radius_rad` of the middle of a scan: those of the catalogue, each
    wrong by the catalogue's own error, and stars that it does not list.
    """
    epoch, t_s = orbit.epoch, attitude.scan.t_s
    p_i, v_i = orbit.states_i(np.array([t_s]))
    middle_i = attitude.scan.R_oi_reference.inv().apply([0.0, 0.0, 1.0])
    unit = unit_vectors(survey.places.ra_rad, survey.places.dec_rad)
    near = survey.take(unit @ middle_i > np.cos(radius_rad + 0.01))
    u_i = apparent_star_directions(near.places, epoch, t_s, p_i[0], v_i[0])
    near = near.take(u_i @ middle_i > np.cos(radius_rad))
    error = near.sigma_at_rad(float(epoch.julian_year(t_s))) * rng.standard_normal((2, len(near.sigma_rad)))
    places = near.places
    true = replace(
        places, ra_rad=places.ra_rad + error[0] / np.cos(places.dec_rad), dec_rad=places.dec_rad + error[1]
    )
    unlisted = _uncatalogued(settings, middle_i, radius_rad, places.epoch_jyear, rng)
    return StarPlaces.together([true, unlisted])


def _uncatalogued(
    settings: SkyStripSettings,
    middle_i: Array,
    radius_rad: float,
    epoch_jyear: float,
    rng: np.random.Generator,
) -> StarPlaces:
    """Stars that no catalogue lists, evenly over a cap of the sky, fainter ones more often."""
    area_deg2 = 2.0 * np.pi * (1.0 - np.cos(radius_rad)) * np.degrees(1.0) ** 2
    count = rng.poisson(settings.uncatalogued_per_deg2 * area_deg2)
    cosine = rng.uniform(np.cos(radius_rad), 1.0, count)
    angle, sine = rng.uniform(0.0, 2.0 * np.pi, count), np.sqrt(1.0 - cosine**2)
    east = np.cross([0.0, 0.0, 1.0], middle_i)
    east /= np.linalg.norm(east)
    north = np.cross(middle_i, east)
    u = (
        np.outer(cosine, middle_i)
        + np.outer(sine * np.cos(angle), north)
        + np.outer(sine * np.sin(angle), east)
    )
    low, high = (3.0**v for v in settings.uncatalogued_v_range)
    return StarPlaces.uncatalogued(
        ra_rad=np.arctan2(u[:, 1], u[:, 0]) % (2.0 * np.pi),
        dec_rad=np.arcsin(u[:, 2]),
        v_mag=np.log(rng.uniform(low, high, count)) / np.log(3.0),
        epoch_jyear=epoch_jyear,
    )


def hot_columns(samples: int, settings: SkyStripSettings, rng: np.random.Generator) -> Array:
    """What each sample of a CCD adds to every row, (N,), DN: nothing but in its hot columns."""
    offset = np.zeros(samples)
    offset[rng.integers(0, samples, settings.hot_columns)] = rng.uniform(
        *settings.hot_column_dn, settings.hot_columns
    )
    return offset


def sky_strip(
    scene: SkyScene,
    ccd: int,
    detector: GroundSettings,
    gain: Grey,
    hot_dn: Array,
    rng: np.random.Generator,
    rows: int,
) -> Iterator[NDArray[Any]]:
    """One CCD's image in blocks (rows, samples), uint8 up to 8 bits and uint16 above.

    `gain` (samples,) is each pixel's own sensitivity, `hot_dn` from `hot_columns`. The image does not depend
    on `rows`.
    """
    settings, lines, samples = scene.settings, scene.settings.lines, len(gain)
    images = [*scene.images(ccd), *_cosmic_rays(settings, samples, rng)]
    level = (settings.background_dn + hot_dn).astype(np.float32)

    def seen_dn(first: int, count: int) -> Callable[[slice], Grey]:
        charge = np.zeros((count, samples), np.float32)
        for row, left, image in images:
            top, bottom = max(first - row, 0), min(first + count - row, len(image))
            start, stop = max(-left, 0), min(samples - left, image.shape[1])
            if top < bottom and start < stop:
                target = charge[row + top - first : row + bottom - first, left + start : left + stop]
                target += image[top:bottom, start:stop]
        seen = charge * (gain * np.float32(1.0 / detector.e_per_dn)) + level
        return lambda panel: seen[:, panel]

    wanted = all_panels(lines, samples)
    if settings.only_around_stars_px:
        places = scene.crossings(ccd)[1]
        wanted = panels_near(places, settings.only_around_stars_px, lines, samples)
    return digitised_strip(seen_dn, lines, samples, detector, rng, rows, wanted)


def _cosmic_rays(
    settings: SkyStripSettings, samples: int, rng: np.random.Generator
) -> Iterator[tuple[int, int, Array]]:
    """Hits of one row and one to three samples each."""
    for _ in range(rng.poisson(settings.cosmic_rays)):
        row, left = int(rng.integers(settings.lines)), int(rng.integers(samples))
        charge = np.exp(rng.uniform(*np.log(settings.cosmic_ray_e)))
        yield row, left, charge * rng.dirichlet(np.ones(int(rng.integers(1, 4))))[None, :]
