"""Lines, arrows and scale over the picture of an image, against the sky that its pixels are said to show."""

import matplotlib
import numpy as np
import pytest
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure

from boresight.features.sky_images.sky_plot import STEPS_DEG, draw_sky

WIDTH, HEIGHT = 1200, 700
MIDDLE = np.array([599.5, 349.5])
RA0, DEC0 = 0.4, 38.0  # right ascension passes 0 within the field
# Degrees towards east and north a column and a row, lopsided: rotated, mirrored, with a pixel of 34 arcsec.
TO_SKY = np.array([[8.0e-3, 4.5e-3], [5.0e-3, -8.5e-3]])


def sky_of(xy_px):
    east, north = TO_SKY @ (np.asarray(xy_px) - MIDDLE).T
    return np.column_stack([(RA0 + east / np.cos(np.radians(DEC0))) % 360.0, DEC0 + north])


@pytest.fixture(scope="module")
def axes():
    with matplotlib.rc_context({"backend": "agg"}):
        return draw_sky(Figure().subplots(), np.zeros((HEIGHT, WIDTH, 3)), (WIDTH, HEIGHT), sky_of)


@pytest.mark.parametrize("of", [0, 1], ids=["right ascension", "declination"])
def test_lines_lie_where_the_coordinate_is_the_one_that_they_are_for(axes, of):
    lines = [one for one in axes.collections if isinstance(one, ContourSet)][of]
    reached = []
    for level, path in zip(lines.levels, lines.get_paths()):
        off = (sky_of(path.vertices)[:, of] - level + 180.0) % 360.0 - 180.0
        assert np.abs(off).max() < 1e-6  # deg: linear between the nodes
        reached.append(path.vertices)
    assert np.ptp(np.diff(lines.levels)) < 1e-9 and np.isclose(STEPS_DEG, np.diff(lines.levels)[0]).any()
    assert 3 <= len(lines.levels) <= 10
    assert axes.get_xlim() == (-0.5, WIDTH - 0.5) and axes.get_ylim() == (HEIGHT - 0.5, -0.5)  # the pixels
    x, y = np.concatenate(reached).T
    assert np.allclose([y.min(), y.max()], [0.0, HEIGHT - 1.0]) and 0.0 <= x.min() < x.max() < WIDTH


def test_arrows_point_east_and_north_from_one_foot_within_the_image(axes):
    arrows = [text for text in axes.texts if getattr(text, "arrow_patch", None)]
    names = [text for text in axes.texts if text.get_text() in ("E", "N")]
    for arrow, name, along in zip(arrows, names, ([1.0, 0.0], [0.0, 1.0]), strict=True):
        foot, head = np.array(arrow.get_position()), np.array(arrow.xy)
        assert 0.85 * WIDTH < foot[0] < WIDTH and 0.8 * HEIGHT < foot[1] < HEIGHT
        moved = TO_SKY @ (head - foot)
        assert moved / np.linalg.norm(moved) == pytest.approx(along, abs=1e-6)
        assert np.linalg.norm(head - foot) == pytest.approx(0.12 * HEIGHT)
        assert (np.array(name.get_position()) - foot) / (head - foot) == pytest.approx([1.25, 1.25])


def test_the_bar_is_as_long_as_it_says_and_the_title_is_the_middle(axes):
    (bar,) = axes.lines
    x, y = bar.get_data()
    (label,) = [text for text in axes.texts if tuple(text.get_position()) == (x[0], 0.91 * HEIGHT)]
    pixel_deg = np.sqrt(abs(np.linalg.det(TO_SKY)))
    assert np.ptp(x) * pixel_deg == pytest.approx(float(label.get_text().rstrip("°")), rel=1e-6)
    assert np.ptp(y) == 0.0 and 0.1 * WIDTH < np.ptp(x) < 0.25 * WIDTH
    assert axes.get_title() == f"RA {RA0:.3f}°, Dec {DEC0:+.3f}°"
