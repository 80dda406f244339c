"""Forms of a star image, what is said of what is not among its stars, and its coordinates on the sky."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from scipy.spatial.transform import Rotation

import boresight as bs
from boresight.geometry.epoch import Epoch
from boresight.geometry.starlight import apparent_star_directions
from boresight.star_id.catalogue import hipparcos_stars

MINI = bs.example("mini")
FULL_DN = 255.0


@pytest.fixture(scope="module")
def pixels() -> np.ndarray:
    with rasterio.open(MINI / "exposures" / "e0001.png") as file:
        return file.read(1)


@pytest.fixture(scope="module")
def solution(pixels: np.ndarray) -> bs.StarSolution:
    camera = bs.open_dump(MINI).star_camera
    found = bs.identify(pixels, camera=camera, time="2024-11-20T03:40:01.6")
    assert found
    return found


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int32, np.uint16])
def test_every_type_of_an_image_gives_the_same_stars(pixels: np.ndarray, kind: type) -> None:
    settings = bs.StarSettings(saturation_dn=FULL_DN)
    known, found = (bs.find_stars(image, settings=settings) for image in (pixels, pixels.astype(kind)))
    assert len(known) == len(found)
    assert known.saturated.any()
    apart = np.linalg.norm(found.xy_px - known.xy_px, axis=1) / known.sigma_px
    assert apart.max() < 0.05  # of a standard error
    np.testing.assert_allclose(found.sigma_px, known.sigma_px, rtol=1e-3)
    assert np.array_equal(found.saturated, known.saturated)


@pytest.mark.parametrize("kind", [np.int16, np.uint16, np.int32, np.int64])
def test_integers_of_a_file_are_counts_whatever_type_holds_them(
    pixels: np.ndarray, kind: type, tmp_path: Path
) -> None:
    known, image = bs.find_stars(pixels), pixels.astype(kind)
    np.save(tmp_path / "sky.npy", image)
    fits.PrimaryHDU(image).writeto(tmp_path / "sky.fits")
    assert known.saturated.any()
    for given in (image, tmp_path / "sky.npy", tmp_path / "sky.fits"):
        found = bs.find_stars(given)
        assert found.pixels is not None and found.pixels.dtype == np.uint8
        for name in ("xy_px", "cov_px", "flux_dn", "saturated"):
            assert np.array_equal(getattr(found, name), getattr(known, name)), name


def test_a_floating_image_without_saturation_says_so(pixels: np.ndarray) -> None:
    stars = bs.find_stars(pixels.astype(float))
    assert not stars.saturated.any()
    assert "saturation level unknown, give StarSettings(saturation_dn=...)" in repr(stars)
    assert "saturation" not in " ".join(bs.find_stars(pixels).not_used)


def test_masked_pixels_and_misshapen_detections_are_counted(pixels: np.ndarray) -> None:
    image = pixels.astype(float)
    image[100:110, 200:220] = np.nan
    stars = bs.find_stars(image)
    assert stars.masked == 200
    assert "200 masked pixels" in repr(stars)
    for colours in (np.stack([image] * 3, axis=2), np.stack([image] * 3), image[None]):
        for given in (colours, np.ma.masked_invalid(colours)):
            assert bs.find_stars(given).masked == 200
    known = bs.find_stars(pixels)
    assert f"{len(known.misshapen_px)} misshapen detections" in repr(known)
    two = np.array([437.0, 362.0])  # bright stars side by side, which no single PSF explains
    assert np.linalg.norm(known.misshapen_px - two, axis=1).min() < 6.0
    assert np.linalg.norm(known.xy_px - two, axis=1).min() > 6.0


def test_stars_of_the_catalogue_lie_where_pixel_to_sky_says(solution: bs.StarSolution) -> None:
    # Hipparcos' own places with proper motion and parallax, no aberration, against the measured pixels.
    places = hipparcos_stars().places
    rows = [int(np.flatnonzero(places.hip == hip)[0]) for hip in solution.hip]
    stars = places.take(np.array(rows))
    years = 2024.885 - stars.epoch_jyear
    catalogue = SkyCoord(
        np.degrees(stars.ra_rad + years * stars.pm_ra_rad_yr),
        np.degrees(stars.dec_rad + years * stars.pm_dec_rad_yr),
        unit="deg",
    )
    measured = solution.pixel_to_sky(solution.xy_px)
    ra, dec = (part.arcsec for part in catalogue.spherical_offsets_to(measured))
    pixel_arcsec = 66.0
    # medians of 88 stars of 0.15 px: 1.5 arcsec; aberration left in would be 20 arcsec
    assert abs(np.median(ra)) < 0.05 * pixel_arcsec
    assert abs(np.median(dec)) < 0.05 * pixel_arcsec


def test_aberration_is_removed_by_the_inverse_of_what_erfa_applies(solution: bs.StarSolution) -> None:
    observer = solution.observer
    assert observer is not None
    stars = hipparcos_stars().places.take(np.arange(50))
    apparent = apparent_star_directions(stars, observer.epoch, observer.t_s, observer.p_i, observer.v_i)
    turned = Rotation.align_vectors([[0.0, 0.0, 1.0]], apparent[:1])[0]
    at_axis = replace(solution, field=replace(solution.field, R_si=turned))
    sky = at_axis.pixel_to_sky(solution.camera.principal_px)
    years = float(observer.epoch.julian_year(observer.t_s)) - stars.epoch_jyear
    known = SkyCoord(
        np.degrees(stars.ra_rad[0] + years * stars.pm_ra_rad_yr[0]),
        np.degrees(stars.dec_rad[0] + years * stars.pm_dec_rad_yr[0]),
        unit="deg",
    )
    assert isinstance(observer.epoch, Epoch)
    assert sky.separation(known).arcsec < 0.2 + max(stars.parallax_arcsec[0], 0.0)  # lens: centre of axis


def test_the_wcs_agrees_with_the_camera_within_its_stated_misfit(solution: bs.StarSolution) -> None:
    wcs = solution.wcs()
    assert isinstance(wcs, WCS)
    xy = np.random.default_rng(4).uniform([0, 0], [1023, 767], (200, 2))
    apart = wcs.pixel_to_world(*xy.T).separation(solution.pixel_to_sky(xy)).arcsec
    assert apart.max() < 66.0 * (solution.wcs_misfit_px + 1e-3)  # arcsec a pixel; 1e-3 between its nodes
    assert solution.wcs_misfit_px < 0.01
    plain = {"projection": "equidistant"} | dict.fromkeys(("p1", "p2", "q1", "q2"), 0.0)
    wide = [replace(solution.camera, focal_m=f * solution.camera.focal_m, **plain) for f in (0.21, 0.195)]
    near, off = (replace(solution, field=replace(solution.field, camera=one)) for one in wide)
    assert 0.3 < near.wcs_misfit_px < 1.0 < off.wcs_misfit_px < 3.0 and isinstance(near.wcs(), WCS)
    with pytest.raises(ValueError, match="at most 1 px; pixel_to_sky has no such limit"):
        off.wcs()


def test_a_mirror_image_has_the_coordinates_of_its_own_pixels(pixels: np.ndarray) -> None:
    direct, mirrored = (bs.identify(image, fov_deg=18.6) for image in (pixels, pixels[:, ::-1].copy()))
    assert direct and mirrored and mirrored.mirrored and not direct.mirrored
    xy = np.array([[100.0, 50.0], [900.0, 700.0]])
    other = xy * [-1.0, 1.0] + [1023.0, 0.0]
    assert direct.pixel_to_sky(xy).separation(mirrored.pixel_to_sky(other)).arcsec.max() < 5.0
    assert mirrored.wcs().pixel_to_world(*other.T).separation(mirrored.pixel_to_sky(other)).arcsec.max() < 1.0
    assert "MIRROR IMAGE" in repr(mirrored)


def test_colours_become_grey_and_other_shapes_are_refused(pixels: np.ndarray) -> None:
    colours = bs.find_stars(np.stack([pixels] * 3, axis=2))
    assert len(colours) == len(bs.find_stars(pixels))
    with pytest.raises(ValueError, match=r"image, pixels: found none that is a number"):
        bs.find_stars(np.full((64, 64), np.nan))
    with pytest.raises(ValueError, match=r"image: found shape \(16, 16\), expected at least 32 px a side"):
        bs.find_stars(np.zeros((16, 16)))
    with pytest.raises(ValueError, match="found integers from -5 to -5, expected counts from 0 to 65535"):
        bs.find_stars(np.full((64, 64), -5))
    with pytest.raises(ValueError, match="time: found 'yesterday', expected UTC since 1972"):
        bs.identify(pixels, time="yesterday")


def test_a_camera_that_the_stars_contradict_is_reported(
    solution: bs.StarSolution, pixels: np.ndarray
) -> None:
    assert solution.misfit_px == 0.0 and "NOT THE CAMERA GIVEN" not in repr(solution)
    longer = replace(solution.camera, focal_m=1.001 * solution.camera.focal_m)
    found = bs.identify(pixels, camera=longer, time="2024-11-20T03:40:01.6")
    assert found and f"NOT THE CAMERA GIVEN: stars are displaced by {found.misfit_px:.2g} px rms" in repr(
        found
    )
    # 1e-3 of columns and rows from the middle, over 1024 x 768 px
    np.testing.assert_allclose(found.misfit_px, 1e-3 * np.sqrt((1024.0**2 + 768.0**2) / 24.0), rtol=0.1)
    # the direction is that of the right camera, to the errors of stars in 20 deg
    off = SkyCoord(found.ra_deg, found.dec_deg, unit="deg").separation(
        SkyCoord(solution.ra_deg, solution.dec_deg, unit="deg")
    )
    assert off.arcsec < 3.0 * found.sigma_arcsec[0]
