"""The picture of `identify --overlay`."""

from dataclasses import replace

import cv2
import matplotlib
import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from command_line import ran
from frames import Sensor, star_frame
from PIL import Image, ImageDraw, ImageFont
from recorded_numbers import assert_recorded
from scipy.spatial.transform import Rotation

from boresight.geometry.geodesy import unit_vectors
from boresight.geometry.star_camera import StarCamera
from boresight.star_id.catalogue import hipparcos_stars

# 18.7° wide
CAMERA = StarCamera(focal_m=0.035, pixel_m=9e-6, width_px=1280, height_px=960, principal_px=(639.5, 479.5))
BETELGEUSE, BELLATRIX, ALNILAM = 27989, 25336, 26311


def place(hip: int) -> SkyCoord:
    places = hipparcos_stars().places
    row = np.searchsorted(places.hip, hip)
    return SkyCoord(places.ra_rad[row] * units.rad, places.dec_rad[row] * units.rad)


def looking_at(ra_deg: float, dec_deg: float) -> Rotation:
    """R_si of a camera that looks there, rolled by 25 degrees."""
    z = unit_vectors(np.radians(ra_deg), np.radians(dec_deg))
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return Rotation.from_euler("z", 25.0, degrees=True) * Rotation.from_matrix([x, np.cross(z, x), z])


@pytest.fixture(scope="module")
def orion(tmp_path_factory):
    """A rendered frame of Orion's upper half, identified, and its coordinates."""
    folder = tmp_path_factory.mktemp("orion")
    R_si = looking_at(82.5, 3.0)
    rng = np.random.default_rng(3)
    image, _ = star_frame(CAMERA, R_si, hipparcos_stars(8.0).places, Sensor(hot_pixels=30), rng)
    cv2.imwrite(str(folder / "orion.png"), image)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        patch.chdir(folder)
        ran("identify", folder / "orion.png", "--fits", "--fov", 18.7, "--overlay", "named.png")
    with fits.open(folder / "orion.wcs.fits") as hdus:
        wcs = WCS(hdus[0].header)
    return np.asarray(Image.open(folder / "named.png")).astype(int), wcs


def written(words: str, picture: np.ndarray, colour: tuple[int, int, int]) -> tuple[float, np.ndarray]:
    """How well `words` are found in the picture, and their middle (column, row)."""
    font = ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", 14)
    size = (round(font.getlength(words)), 14)
    drawn = Image.new("RGB", size)
    ImageDraw.Draw(drawn).text((0, 7), words, colour, font, "lm", stroke_width=2, stroke_fill=(0, 0, 0))
    found = cv2.matchTemplate(picture.astype(np.float32), np.float32(drawn), cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(found.argmax(), found.shape)
    return float(found.max()), np.array([column, row]) + 0.5 * np.array(size)


@pytest.mark.parametrize(
    ("hip", "words"),
    [(BETELGEUSE, "Betelgeuse 0.4"), (BELLATRIX, "Bellatrix 1.6"), (ALNILAM, "Alnilam 1.7")],  # V of ESA 1997
)
def test_a_bright_star_has_its_name_and_magnitude_beside_it(orion, hip, words):
    picture, wcs = orion
    likeness, at = written(words, picture, (255, 250, 225))
    assert likeness > 0.8  # 1 if it lay on black and whole pixels
    star = np.array(wcs.world_to_pixel(place(hip)))
    away = np.abs(at - star)
    half_a_label_and_ring = 60.0 + 30.0  # px
    assert away[0] < half_a_label_and_ring and away[1] < 40.0


def test_a_small_image_is_enlarged_and_its_rings_lie_about_its_stars(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    camera = replace(CAMERA, width_px=400, height_px=300, pixel_m=28.8e-6, principal_px=(199.5, 149.5))
    R_si = looking_at(82.5, 3.0)
    rng = np.random.default_rng(3)
    image, truth = star_frame(camera, R_si, hipparcos_stars(8.0).places, Sensor(hot_pixels=0), rng)
    cv2.imwrite(str(tmp_path / "small.png"), image)
    ran("identify", tmp_path / "small.png", "--fov", 18.7, "--overlay", tmp_path / "o.png")
    picture = np.asarray(Image.open(tmp_path / "o.png")).astype(int)
    assert picture.shape == (900, 1200, 3)  # three times, the longer side then has 960 px at least
    coloured = np.abs(np.diff(picture, axis=2)).sum(axis=2)
    assert_recorded("overlay", {"columns": coloured.sum(axis=0), "rows": coloured.sum(axis=1)}, relative=1e-3)
    off = []
    for at in (truth.xy_px[np.argsort(-truth.flux_dn, kind="stable")[:20]] + 0.5) * 3.0 - 0.5:
        x, y = np.rint(at).astype(int)
        if min(x, y, 1199 - x, 899 - y) > 20:
            around = picture[y - 20 : y + 21, x - 20 : x + 21]
            row, column = np.nonzero((around[:, :, 1] > 200) & (around[:, :, 0] < 120))  # green
            off.append(np.median([column + x - 20, row + y - 20], axis=1) - at)
    # Labels and neighbours hide parts of rings; half a pixel of the image too many would be 1.5.
    assert len(off) > 10 and np.abs(np.median(off, axis=0)).max() < 0.8
