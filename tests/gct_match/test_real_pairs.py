"""Two dates that a real satellite saw: Sentinel-2, 10 m, clouds in the second."""

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rendered_pairs import DATA

from boresight.gct_match.imaging.views import view_of
from boresight.gct_match.locate import locate
from boresight.gct_match.settings import MatchSettings

SIZE, MARGIN = 128, 16


def band(name: str) -> NDArray:
    path = DATA / "pairs" / name
    if not path.exists():
        pytest.skip(f"real pair of dates is not here: {path}")
    with rasterio.open(path) as file:
        return file.read(1).astype(np.float32)


def test_sentinel_dates_agree_to_a_twentieth_of_a_pixel():
    a, b = band("s2_a.jp2"), band("s2_b.jp2")
    left, down = 544, -449  # where b's first pixel lies in a, by the two files' georeferencing
    middle = np.array([(SIZE - 1) / 2.0] * 2)
    places, shifts = [], []
    for y in range(480, b.shape[0] - 300, 260):
        for x in range(64, b.shape[1] - 300, 260):
            if x + left + SIZE > a.shape[1] or y + down + SIZE > a.shape[0]:
                continue
            template = a[y + down : y + down + SIZE, x + left : x + left + SIZE]
            window = b[y - MARGIN : y + SIZE + MARGIN, x - MARGIN : x + SIZE + MARGIN]
            views = (view_of(image, image > 0.0) for image in (template, window))
            outcome = locate(*views, (MARGIN, MARGIN), MARGIN, middle, MatchSettings())
            if outcome:
                places.append((x, y))
                shifts.append(outcome.xy_px - middle - MARGIN)
    design = np.column_stack([np.ones(len(places)), np.array(places) / 1000.0])
    model, *_ = np.linalg.lstsq(design, np.array(shifts), rcond=None)
    miss = np.array(shifts) - design @ model
    assert len(places) >= 25
    assert np.abs(miss).max() < 0.5  # px: none is gross
    assert np.sqrt(np.mean(miss**2)) < 0.055  # px, the figure to beat; the sensor's own jitter is part of it
    assert np.median(shifts, axis=0) == pytest.approx([0.67, -1.95], abs=0.2)  # px, as known of the pair


YEARS = ("20150926", "20170827", "20190904")


def test_years_of_changed_ground_are_kept_and_close():
    """NAIP: lakes, crops and soil of three years; what has moved from a to b and on to c, has from a to c."""
    images = []
    for year in YEARS:
        path = DATA / "pairs" / f"naip_{year}.tif"
        if not path.exists():
            pytest.skip(f"real pairs of years are not here: {path}")
        with rasterio.open(path) as file:
            images.append(file.read([1, 2, 3]).mean(axis=0).astype(np.float32))

    def found(one: int, two: int, x: int, y: int) -> tuple[NDArray, NDArray] | None:
        template = images[one][y : y + SIZE, x : x + SIZE]
        window = images[two][y - MARGIN : y + SIZE + MARGIN, x - MARGIN : x + SIZE + MARGIN]
        views = (view_of(image, image > 0.0) for image in (template, window))
        outcome = locate(*views, (MARGIN, MARGIN), MARGIN, np.full(2, 63.5), MatchSettings())
        return (outcome.xy_px - 63.5 - MARGIN, outcome.cov_px) if outcome else None

    places = [(x, y) for y in range(40, 540, 120) for x in range(40, 760, 120)]
    kept, squares = 0, []
    for x, y in places:
        ab, ac = found(0, 1, x, y), found(0, 2, x, y)
        kept += (ab is not None) + (ac is not None)
        if ab and ac:
            u, v = (np.round(ab[0]) + np.array([x, y])).astype(int)
            if bc := found(1, 2, u, v):
                error = ab[0] + bc[0] - ac[0]
                squares.append(error @ np.linalg.solve(ab[1] + bc[1] + ac[1], error))
    assert kept >= 0.5 * 2 * len(places)  # 3 % where a fit had to be good to a tenth of a pixel
    assert len(squares) >= 10
    assert np.mean(squares) / 2.0 < 2.0  # of two axes; one, and an error of its mean of 0.25
