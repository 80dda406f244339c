"""RPCs against the rigorous model, through GDAL's own transformer."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
from orbiting_camera import LINES, NOTES, strip
from rasterio.rpc import RPC
from rasterio.transform import RPCTransformer

from boresight.features.exports.ground_error import GroundError
from boresight.features.exports.rpc import fit_rpc, rpc_metadata, rpc_text
from boresight.features.exports.vrt import vrt_with_rpc
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.terrain import ConstantHeight

HEIGHTS = (-100.0, 1400.0)
ON_GROUND = GroundError(bias_m=2.5, random_m=0.5)


def test_gdal_finds_the_pixels_of_the_rigorous_model_within_the_stated_error(tmp_path):
    """At 1000 random points of other heights than those of the fit, for both CCDs."""
    rng = np.random.default_rng(11)
    for ccd in (0, 1):
        rpc, error = fit_rpc(strip(), ccd, LINES, HEIGHTS)
        size = (strip().camera.n_px(ccd), LINES)
        image = tmp_path / f"image{ccd}.tif"
        profile = {"driver": "GTiff", "width": size[0], "height": size[1], "count": 1, "dtype": "uint8"}
        with rasterio.open(image, "w", **profile, sparse_ok=True):
            pass
        (tmp_path / f"image{ccd}_RPC.TXT").write_text(rpc_text(rpc, ON_GROUND))
        vrt = tmp_path / f"image{ccd}.vrt"
        vrt.write_text(vrt_with_rpc(image, size, "Byte", rpc_metadata(rpc, ON_GROUND), NOTES))
        sample, line = rng.uniform(0, size[0] - 1, 1000), rng.uniform(0, LINES - 1, 1000)
        height = np.repeat(rng.uniform(*HEIGHTS, 50), 20)
        p_e = np.concatenate(
            [
                strip().ground_points(ccd, sample[n : n + 20], line[n : n + 20], ConstantHeight(height[n]))
                for n in range(0, 1000, 20)
            ]
        )
        lat, lon, _ = geodetic_from_ecef(p_e, WGS84)
        # scaled values of RPC00B are -1 to 1 over the image from edge to edge, its heights and its ground
        ends = np.array([[-0.5, -0.5, HEIGHTS[0]], [LINES - 0.5, size[0] - 0.5, HEIGHTS[1]]])
        scaled = (ends - rpc.offsets[[0, 1, 4]]) / rpc.scales[[0, 1, 4]]
        assert scaled == pytest.approx(np.array([[-1.0] * 3, [1.0] * 3]), abs=1e-12)
        for values, n in ((np.degrees(lat), 2), (np.degrees(lon), 3)):
            within = (values - rpc.offsets[n]) / rpc.scales[n]
            # of 1000 random points; the outermost are near to a corner and to the least or largest height
            assert -1.001 < within.min() < -0.8 and 0.8 < within.max() < 1.001
        for path in (image, vrt):
            with rasterio.open(path) as file:
                assert isinstance(file.rpcs, RPC)
                transformer = RPCTransformer(file.rpcs)
            rows, columns = transformer.rowcol(np.degrees(lon), np.degrees(lat), zs=height, op=np.asarray)
            # GDAL counts from the corner of the first pixel.
            miss = np.hypot(np.array(columns) - 0.5 - sample, np.array(rows) - 0.5 - line)
            # 1e-6 px: text of 17 digits; other points than those of `error` may miss by a fifth more.
            assert np.sqrt(np.mean(miss**2)) == pytest.approx(error.rms_px, rel=0.1, abs=1e-6)
            assert miss.max() < 1.2 * error.largest_px + 1e-6
        assert error.rms_px < 0.05  # 5 px of odd distortion follow no cubic


@pytest.mark.parametrize("later_rows", [0.0, 97.37, 412.37])
def test_denominators_have_no_zero_within_the_image_and_its_heights(later_rows):
    """A zero makes a spike of many pixels, which random points may miss."""
    model = replace(strip(), rows=replace(strip().rows, first_row={1: later_rows}))
    rpc, error = fit_rpc(model, 1, LINES, HEIGHTS)
    lat, lon, height = (a.ravel() for a in np.meshgrid(*[np.linspace(-1.0, 1.0, 15)] * 3, indexing="ij"))
    terms = np.stack([np.ones_like(lat), lon, lat, height], axis=1)
    for denominator in (rpc.line_den, rpc.sample_den):
        linear = terms @ denominator[:4]
        assert np.all(np.abs(linear + np.abs(denominator[4:]).sum() - 1.0) < 0.2)  # of 1, in scaled units
    assert error.largest_px < 1e-3


def test_heights_without_ground_give_no_rpc():
    with pytest.raises(ValueError, match="no ground"):
        fit_rpc(strip(), 0, LINES, (0.0, np.nan))
