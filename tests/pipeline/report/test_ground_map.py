"""Quicklooks of strips: each pixel has the grey value of the place where it lies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from pytest import approx

from boresight.gct_match.settings import MatchSettings
from boresight.pipeline.files.image_files import StripFiles
from boresight.pipeline.report.strip_overview import BAND_LINES, OverviewTask, overview


@pytest.mark.parametrize(
    ("lines", "tile", "banded"), [(4000, 16, True), (4000, 512, False), (500, 16, False)]
)
def test_an_overview_of_a_slope_is_the_slope(lines: int, tile: int, banded: bool, tmp_path: Path) -> None:
    row, column = np.mgrid[:lines, :700]
    grey = 10 * row + 30 * column  # at most 60 970
    form = {"tiled": True, "blockxsize": 512, "blockysize": tile, "compress": "deflate"}
    with rasterio.open(
        tmp_path / "s.tif", "w", driver="GTiff", width=700, height=lines, count=1, dtype="uint16", **form
    ) as file:
        file.write(grey.astype(np.uint16), 1)
    strip = StripFiles(paths={0: tmp_path / "s.tif"}, names={0: "s.tif"}, shapes={0: (lines, 700)})
    found = overview(OverviewTask(strip_id="s", images=strip, ccd=0, settings=MatchSettings()))
    (sample, line), (across, along) = found.first_px, found.pitch_px
    assert (along > across) == banded and (not banded or line == 0.5 * (BAND_LINES - 1))
    i, j = np.indices(found.means.shape)
    # means of integers are rounded once for each halving of the blocks' sides, 4 at most
    assert found.means == approx(10 * (line + along * i) + 30 * (sample + across * j), abs=0.5 * 4)
