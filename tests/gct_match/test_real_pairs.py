"""Two dates that a real satellite saw: Sentinel-2, 10 m, clouds in the second."""

from __future__ import annotations

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
