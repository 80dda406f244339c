"""Centroids of other programs arrays, tables, cut and joined lists name stars as images do."""

import cv2
import numpy as np
import pandas as pd
import pytest

import boresight as bs

SCENE = bs.example("mini") / "exposures"


@pytest.fixture(scope="module")
def stars():
    return bs.find_stars(SCENE / "e0001.png")


@pytest.fixture(scope="module")
def named(stars):
    return bs.identify(stars, fov_deg=20)


def apart_arcsec(found, other):
    off = (found.ra_deg - other.ra_deg) * np.cos(np.radians(other.dec_deg)), found.dec_deg - other.dec_deg
    return 3600.0 * np.hypot(*off)


def test_positions_alone_name_what_the_image_shows(stars, named):
    found = bs.identify(stars.xy_px, size=stars.size_px, fov_deg=20)
    assert set(named.hip[:30]) <= set(found.hip)
    # centroids of the bright stars are ten times better than the 0.2 px assumed of all alike
    assert apart_arcsec(found, named) < 4.0 * found.sigma_arcsec[0]


def test_a_table_with_errors_gives_the_answer_of_the_list(stars, named):
    cov = stars.cov_px
    table = pd.DataFrame({"x_px": stars.xy_px[:, 0], "y_px": stars.xy_px[:, 1], "snr": stars.snr})
    table["sigma_x_px"], table["sigma_y_px"] = np.sqrt(cov[:, 0, 0]), np.sqrt(cov[:, 1, 1])
    table["cov_xy_px2"], table["flux_dn"] = cov[:, 0, 1], stars.flux_dn
    shuffled = table.sample(frac=1.0, random_state=3)  # the flux tells the order
    found = bs.identify(shuffled, size=stars.size_px, fov_deg=20)
    assert set(found.hip) >= set(named.hip[:100])
    # but for blended stars, which a table does not tell
    assert apart_arcsec(found, named) < named.sigma_arcsec[0]
    assert found.sigma_arcsec[0] == pytest.approx(named.sigma_arcsec[0], rel=0.2)


def test_a_camera_tells_the_size_of_the_image(stars, named):
    found = bs.identify(stars.xy_px, camera=named.camera)
    assert set(named.hip[:30]) <= set(found.hip)
    listed = bs.identify(stars.xy_px.tolist(), camera=named.camera)
    assert (listed.R_si * found.R_si.inv()).magnitude() == 0.0
    track = bs.track([stars.xy_px, stars, SCENE / "e0001.png"], camera=named.camera)
    assert "lost" not in track.state
    assert (track.R_si(0) * track.R_si(1).inv()).magnitude() < 1e-4  # rad; a third of a pixel


def test_lists_are_cut_and_joined_in_the_order_of_flux(stars):
    first, rest = stars[:20], stars[20:]
    assert len(first) == 20 and np.array_equal((rest + first).xy_px, stars.xy_px)
    assert (stars[stars.snr > 50.0].snr > 50.0).all()
    assert len(stars[3]) == 1
    with pytest.raises(ValueError, match="stars of an image of"):
        first + bs.Stars.of_centroids(stars.xy_px, size_px=(2048, 2048))


@pytest.mark.parametrize(
    "given, size, said",
    [
        (np.zeros((5, 2)), None, "size"),
        (np.full((5, 2), np.nan), (64, 64), "finite"),
        (pd.DataFrame({"x_px": [1.0]}), (64, 64), "also y_px"),
        (pd.DataFrame({"x_px": [1.0], "y_px": [1.0], "sigma_px": [0.0]}), (64, 64), "sigma_px"),
        (pd.DataFrame({"x_px": [1.0], "y_px": [1.0], "sigma_x_px": [0.1]}), (64, 64), "also sigma_y_px"),
        (pd.DataFrame({"x_px": [1], "y_px": [1], "sigma_x_px": [-1], "sigma_y_px": [1]}), (9, 9), "above 0"),
        (np.array([[1.0, 2.0], [700.0, 3.0]]), (480, 640), "220.5 px outside of"),  # (height, width)
        (np.array([[1.0, -2.0]]), (480, 640), "1.5 px outside of"),
        (np.zeros((64, 64), np.uint8), (64, 64), "size"),
    ],
)
def test_what_is_no_list_of_centroids_is_refused_in_words(given, size, said):
    with pytest.raises(ValueError, match=said):
        bs.identify(given, size=size)


@pytest.mark.parametrize("size", [1.0, 1e-4, 1e-8])  # px²
def test_errors_of_centroids_are_positive_and_covariances_symmetric(size):
    xy, even = np.array([[5.0, 6.0], [7.0, 8.0]]), size * np.array([[2.0, 0.5], [0.5, 1.0]])
    kept = bs.Stars.of_centroids(xy, size_px=(64, 64), cov_px=[even, even])
    assert kept.cov_px[1].tolist() == even.tolist()
    for wrong in ([[2.0, 0.5], [0.6, 1.0]], [[2.0, 0.5], [0.0, 1.0]], [[2.0, 3.0], [3.0, 1.0]], -even / size):
        with pytest.raises(ValueError, match=r"^cov_px: found .*, expected errors above 0 px"):
            bs.Stars.of_centroids(xy, size_px=(64, 64), cov_px=[even, size * np.array(wrong)])
    for sigma in (-np.sqrt(size), [size, -size], 0.0):
        with pytest.raises(ValueError, match=r"^sigma_px: found .*, expected errors above 0 px"):
            bs.Stars.of_centroids(xy, size_px=(64, 64), sigma_px=sigma)


def test_an_empty_list_is_not_identified():
    assert not bs.identify(np.empty((0, 2)), size=(640, 480))


def test_an_opencv_camera_projects_as_opencv_does():
    matrix = np.array([[900.0, 0, 330], [0, 900.0, 235], [0, 0, 1]])
    distortion = [-0.2, 0.05, 1e-3, -2e-3, 0.01]
    camera = bs.StarCamera.from_opencv(matrix, distortion, size_px=(640, 480))
    v = np.random.default_rng(2).uniform([-0.3, -0.2, 1.0], [0.3, 0.2, 1.0], (50, 3))
    expected = cv2.projectPoints(v, np.zeros(3), np.zeros(3), matrix, np.array(distortion))[0][:, 0]
    u_s = v * [-1.0, -1.0, 1.0] / np.linalg.norm(v, axis=1, keepdims=True)
    assert np.abs(camera.pixels_from_directions(u_s) - expected).max() < 1e-9  # px, of rounding
    back = camera.opencv_parameters()
    assert np.allclose(back.camera_matrix, matrix) and np.allclose(back.distortion, distortion)
    plain = [
        bs.StarCamera.from_opencv(matrix.tolist(), no, size_px=(640, 480)) for no in (None, (), [0.0] * 8)
    ]
    assert repr(plain[0]) == repr(plain[1]) == repr(plain[2])
    for wrong in (matrix.T, 2.0 * matrix, matrix[:2], 900.0, np.nan * matrix):
        with pytest.raises(ValueError, match=r"^camera_matrix: \(f, 0, x\)"):
            bs.StarCamera.from_opencv(wrong, size_px=(640, 480))
    with pytest.raises(ValueError, match="alike"):
        bs.StarCamera.from_opencv(np.diag([900.0, 950.0, 1.0]), size_px=(640, 480))
