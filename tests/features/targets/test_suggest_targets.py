"""Targets from ortho-images: maps, dates, heights, what strips show; and that a dump takes the folder."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from statistics import stdev
from types import SimpleNamespace as Of

import cv2
import numpy as np
import pandas as pd
import pytest
import rasterio
import strips
from command_line import invoked, ran
from edits import rows_of
from fixture_strips import FIXTURE, strip_of_fixture
from pyproj import Transformer
from rasters import write_raster
from recorded_numbers import assert_recorded, columns_of, numbers_in
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from boresight.features.targets import suggestions
from boresight.features.targets.ortho_files import RasterWindow, open_raster, read_heights
from boresight.geometry.constants import ARCSEC
from boresight.geometry.geoid import egm96
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import open_dump

EPSG, PIXEL_M = 32633, 2.0


def read_ortho(path: Path, band: int | None = None) -> RasterWindow:
    """All pixels of a raster."""
    file = open_raster(path, band)
    return file.window(0, 0, file.shape[1], file.shape[0])


def texture(seed: int, shape: tuple[int, int] = (400, 500)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    blocks = np.kron(rng.integers(20, 230, (shape[0] // 10, shape[1] // 10)), np.ones((10, 10)))
    return np.clip(blocks + rng.normal(0.0, 1.0, shape), 0, 255).astype(np.uint8)


def write(path: Path, bands: np.ndarray, east: float = 4e5, north: float = 5e6, **profile: object) -> Path:
    placed = {"crs": f"EPSG:{EPSG}", "transform": rasterio.Affine(PIXEL_M, 0, east, 0, -PIXEL_M, north)}
    return write_raster(path, bands, **placed | profile)


def dem(path: Path) -> Path:
    """Heights that rise by 10 m a degree of latitude from 100 m at 45 degrees north, in degrees."""
    rows = np.repeat(100.0 + 10.0 * (45.5 - (np.arange(60) + 0.5) / 60 - 45.0), 60).reshape(60, 60)
    transform = rasterio.Affine(1 / 60, 0, 13.3, 0, -1 / 60, 45.5)
    return write(path, rows.astype(np.float32), crs="EPSG:4326", transform=transform)


def suggested(out: Path, *arguments: object, size_px: int = 64, recorded: str = "") -> list[dict[str, str]]:
    told = ran("targets", "suggest", *arguments, "--out", out, "--size-px", size_px, "--most", 6)
    rows = rows_of(out / "targets.csv")
    (out / "told.txt").write_text(told.output)
    if recorded:
        chips = [cv2.imread(str(out / row["chip"]), cv2.IMREAD_UNCHANGED).mean() for row in rows]
        found = columns_of(pd.read_csv(out / "targets.csv")) | {"chips": chips}
        printed = [numbers_in(line) for line in told.output.splitlines() if " -> " not in line]
        found |= {f"printed {n}": np.array(values) for n, values in enumerate(zip(*printed[:6]))}
        assert_recorded(
            f"targets_{recorded}",
            found | {"printed of all": np.concatenate([[], *printed[6:]])},
            relative=5e-4,
        )
    return rows


def test_heights_of_a_dem_are_stated_as_the_dump_wants_them(tmp_path: Path) -> None:
    ortho, heights = write(tmp_path / "o.tif", texture(1)), dem(tmp_path / "d.tif")
    for kind in ("egm96", "ellipsoidal"):
        rows = suggested(tmp_path / kind, ortho, "--dem", heights, "--heights", kind, "--sigma-up-m", 3)
        assert {(row["height_kind"], row["sigma_up_m"]) for row in rows} == {(kind, "3.000")}
        for row in rows:
            assert float(row["height_m"]) == pytest.approx(100 + 10 * (float(row["lat_deg"]) - 45), abs=2e-3)
            assert 1.0 <= float(row["sigma_east_m"]) < 1.1  # georeferencing, and the texture's part
    model = read_heights([heights], "egm96")
    lat, lon = np.array([45.1]), np.array([13.7])
    ellipsoidal = 101.0 + egm96().undulation_m(np.radians(lat), np.radians(lon))
    assert model.ellipsoidal(lat, lon) == pytest.approx(ellipsoidal, abs=2e-3)


def test_a_geoid_whose_grid_is_not_installed_is_named(tmp_path: Path) -> None:
    from pyproj.transformer import TransformerGroup

    if TransformerGroup("EPSG:9518", "EPSG:4979").best_available:
        pytest.skip("THE EGM2008 GRID OF PROJ IS INSTALLED: its absence was not tested")
    with pytest.raises(RawDataError, match=r"egm2008, no grid of it is installed|no grid of it is installed"):
        read_heights([dem(tmp_path / "d.tif")], "egm2008")


ABOVE_EGM2008 = """
import json, sys
from pathlib import Path
import numpy as np
import pyproj
pyproj.datadir.append_data_dir(sys.argv[2])
from boresight.features.targets.ortho_files import read_heights
lat, lon = np.array([45.1, 44.8]), np.array([13.7, 13.4])
model = read_heights([Path(sys.argv[1])], "egm2008")
height, kind = model.stated(lat, lon)
print(json.dumps([kind, height.tolist(), model.ellipsoidal(lat, lon).tolist()]))
"""


def test_heights_above_egm2008_are_put_on_the_ellipsoid_by_the_grid_of_proj(tmp_path: Path) -> None:
    # The real grid (80 MB) is replaced by a plane under its name, N = 40 + 2 (lat - 45) + (lon - 13.5): PROJ
    # reads it as the real one, and bilinear interpolation gives a plane exactly.
    step, west, north = 1.0 / 24.0, 12.0, 47.0
    lat = north - (np.arange(96) + 0.5) * step
    lon = west + (np.arange(96) + 0.5) * step
    undulation = 40.0 + 2.0 * (lat[:, None] - 45.0) + (lon - 13.5)
    (tmp_path / "proj").mkdir()
    write(
        tmp_path / "proj" / "us_nga_egm08_25.tif",
        undulation.astype(np.float32),
        crs="EPSG:4326",
        transform=rasterio.Affine(step, 0, west, 0, -step, north),
    )
    command = [sys.executable, "-c", ABOVE_EGM2008, str(dem(tmp_path / "d.tif")), str(tmp_path / "proj")]
    ran = subprocess.run(command, capture_output=True, text=True)  # its own PROJ: folders are for all
    assert ran.returncode == 0, ran.stderr
    kind, stated, ellipsoidal = json.loads(ran.stdout)
    assert kind == "ellipsoidal" and stated == ellipsoidal  # targets.csv knows no EGM2008
    assert stated == pytest.approx([101.0 + 40.4, 98.0 + 39.5], abs=2e-3)  # m: single precision of both grids


def test_colours_masks_and_virtual_mosaics_are_read(tmp_path: Path) -> None:
    rgb = np.stack([texture(n) for n in (1, 2, 3, 4)])
    path = write(tmp_path / "rgb.tif", rgb, nodata=0, driver="COG")
    ortho = read_ortho(path)
    np.testing.assert_allclose(ortho.values, rgb[:3].astype(float).mean(axis=0), atol=1e-4)
    assert np.array_equal(read_ortho(path, 4).values, rgb[3])
    with pytest.raises(RawDataError, match="--band: found 5, expected 1 to 4"):
        read_ortho(path, 5)
    vrt = tmp_path / "m.vrt"
    vrt.write_text(
        f'<VRTDataset rasterXSize="500" rasterYSize="400"><SRS>EPSG:{EPSG}</SRS><GeoTransform>400000, 2, 0, '
        '5000000, 0, -2</GeoTransform><VRTRasterBand dataType="Byte" band="1"><SimpleSource><SourceFilename '
        'relativeToVRT="1">rgb.tif</SourceFilename><SourceBand>2</SourceBand></SimpleSource></VRTRasterBand>'
        "</VRTDataset>"
    )
    assert np.array_equal(read_ortho(vrt).values, rgb[1])
    (tmp_path / "no.tif").write_bytes(b"II*\0nonsense")
    with pytest.raises(RawDataError, match=r"no\.tif: file"):
        read_ortho(tmp_path / "no.tif")


def test_places_that_changed_between_two_dates_are_avoided(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new, old = texture(1), texture(1)
    old[:, :250] = texture(9)[:, :250]  # the western half has changed
    images = write(tmp_path / "new.tif", new), write(tmp_path / "old.tif", old, east=4e5 + PIXEL_M)
    rows = suggested(tmp_path / "t", *images, "--height-m", 300, recorded="of_dates")
    east = Transformer.from_crs(4326, EPSG, always_xy=True).transform(
        [float(row["lon_deg"]) for row in rows], [float(row["lat_deg"]) for row in rows]
    )[0]
    # Within 40 px of its border the other image does not cover a chip and its margin.
    changed = [x for x in east if 4e5 + 41 * PIXEL_M < x < 4e5 + 250 * PIXEL_M]
    assert len(rows) == 6 and changed == []
    monkeypatch.setattr(suggestions, "TILE_PX", 256)  # four tiles
    alone = suggested(tmp_path / "alone", images[0], "--height-m", 300, recorded="of_tiles")
    assert len(alone) == 6  # each row of both images once: no place twice
    assert len({(row["lat_deg"], row["lon_deg"]) for row in rows}) == 6


def test_heights_of_another_place_are_named_with_the_image(tmp_path: Path) -> None:
    ortho = write(tmp_path / "o.tif", texture(1))
    elsewhere = write(
        tmp_path / "far.tif",
        np.full((60, 60), 100.0, np.float32),
        crs="EPSG:4326",
        transform=rasterio.Affine(1 / 60, 0, 3.3, 0, -1 / 60, 45.5),
    )
    refused = invoked("targets", "suggest", ortho, "--dem", elsewhere, "--out", tmp_path / "t").exception
    assert isinstance(refused, RawDataError) and "o.tif: place: found latitude 45." in str(refused)
    assert "longitude 13." in str(refused) and "far.tif does not" in str(refused)
    assert len(suggested(tmp_path / "both", ortho, "--dem", elsewhere, "--dem", dem(tmp_path / "d.tif"))) == 6


def test_chips_lie_about_their_targets_and_sigma_has_what_two_dates_differ_by(tmp_path: Path) -> None:
    rows = suggested(tmp_path / "t", write(tmp_path / "o.tif", texture(1)), "--height-m", 1, "--sigma-m", 0)
    # 0.07 px of 2 m; the part of the texture, 0.002 px, adds 4 % of a millimetre
    assert {row["sigma_east_m"] for row in rows} == {row["sigma_north_m"] for row in rows} == {"0.140"}
    to_degrees = Transformer.from_crs(EPSG, 4326, always_xy=True)
    for row in rows:
        with rasterio.open(tmp_path / "t" / row["chip"]) as chip:
            assert chip.shape == (64, 64)
            expected = to_degrees.transform(*(chip.transform @ (32.5, 32.5)))
        # the list has nine decimals of a degree: 0.1 mm
        assert (float(row["lon_deg"]), float(row["lat_deg"])) == pytest.approx(expected, abs=2e-9)


def test_heights_are_needed_and_one_kind_of_them(tmp_path: Path) -> None:
    ortho = write(tmp_path / "o.tif", texture(1))
    for given in ([], ["--height-m", "1", "--dem", "d.tif"]):
        told = ran("targets", "suggest", ortho, "--out", tmp_path / "t", *given, status=2)
        assert "--dem" in told.output


@pytest.fixture(scope="module")
def at_a_strip(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A dump of one strip, and an ortho-image: every third of its chips laid out where it belongs."""
    folder = tmp_path_factory.mktemp("suggest")
    strip_of_fixture(folder / "dump", 2)
    chips = sorted((FIXTURE / "chips").glob("s02-*.tif"))[::3]
    with rasterio.open(chips[0]) as first:
        crs, side = first.crs, first.transform.a
    boxes = [rasterio.open(chip).bounds for chip in chips]
    west, north = min(box.left for box in boxes), max(box.top for box in boxes)
    east, south = max(box.right for box in boxes), min(box.bottom for box in boxes)
    mosaic = np.zeros((round((north - south) / side) + 1, round((east - west) / side) + 1), np.uint8)
    for chip, box in zip(chips, boxes):
        with rasterio.open(chip) as file:
            top, left = round((north - box.top) / side), round((box.left - west) / side)
            mosaic[top : top + file.height, left : left + file.width] = file.read(1)
    transform = rasterio.Affine(side, 0, west, 0, -side, north)
    return folder / "dump", write(folder / "ortho.tif", mosaic, crs=crs, transform=transform, nodata=0)


def test_the_folder_goes_into_the_dump(at_a_strip: tuple[Path, Path], tmp_path: Path) -> None:
    dump, ortho = at_a_strip
    terrain = dump / "terrain" / "dem.tif"
    rows = suggested(tmp_path / "t", ortho, "--dem", terrain, "--dump", dump, size_px=40, recorded="of_strip")
    assert 1 <= len(rows) <= 6
    # from 530 km: 2 m of the orbit, 0.8 m of the clock and at most 2.3 m of targets with one error in common
    x_y = np.radians(numbers_in((tmp_path / "t/told.txt").read_text().split("arcsec")[1])[:2]) / 3600.0
    assert np.all(530e3 * x_y > 2.0) and np.all(530e3 * x_y < 3.1)
    shutil.rmtree(dump / "chips")
    shutil.copytree(tmp_path / "t" / "chips", dump / "chips")
    shutil.copy(tmp_path / "t" / "targets.csv", dump / "targets.csv")
    assert [target.target_id for target in open_dump(dump).targets] == [row["id"] for row in rows]
    assert "in view of s02" in ran("dump", "check", dump).output


def test_the_chance_that_a_strip_shows_a_place_is_that_of_the_error_of_the_matrix(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = strips.strip()
    monkeypatch.setattr(suggestions, "pushbroom_of", lambda task: model)
    # arcsec about x, y, z of c; the last, about the line of sight, does not count
    sigma, lines = np.array([70.0, 25.0, 1.0]) * ARCSEC, {0: 20_000, 2: 26_000}
    task = Of(camera=model.camera, strip=Of(ccd_lines=lines, strip_id="s"), sigma_installation_rad=sigma)
    ccd = [0, 2, 2, 0, 2, 2]
    at = np.array(
        [[-90, 9e3], [2e3, 26_040], [3e3, 7e3], [6_300, -60], [15, 25_930], [4e3, 26_700]], dtype=np.float64
    )
    p_e = [model.ground_points(c, *xy[:, None], ConstantHeight(50.0))[0] for c, xy in zip(ccd, at)]
    rows = zip("abcdef", p_e, (0.1, 0.2, 0.3, 0.4, 0.5, 0.6), (0.9, 0.8, 0.7, 0.6, 0.5, 0.4))
    named = [Of(target_id=id, p_e=p, sigma_px=px, probability=same) for id, p, px, same in rows]
    matched, chance = suggestions._in_view(task, named)
    assert matched.target_id.tolist() == list("abcde") and matched.ccd.tolist() == ccd[:5]

    turns = [Rotation.from_rotvec(1e-5 * axis) for axis in np.eye(3)[:2]]
    expected = []
    for n in range(5):
        most = np.array([6144, lines[ccd[n]]]) - 1
        moved = [
            replace(model, R_cs=turn * model.R_cs).pixels_from_ground(ccd[n], [p_e[n]]) for turn in turns
        ]
        slopes = (np.array(moved)[:, :, 0] - at[n]) / 1e-5 * sigma[:2, None]  # px a sigma about x and y
        inside = [
            quad(norm(x, np.hypot(*slope)).pdf, 0.0, end, points=[x, 0.0, end])[0]
            for x, slope, end in zip(at[n], slopes.T, most)
        ]
        expected.append(named[n].probability * np.prod(inside))
        assert matched.xy_px[n] == pytest.approx(np.clip(at[n], 0.0, most), abs=1e-3)  # px
        assert matched.cov_px[n] == pytest.approx(named[n].sigma_px ** 2 * np.eye(2), rel=1e-12)
    # 5e-3: the scale of the first pixel stands for all of a strip, in which it changes by 2e-3
    np.testing.assert_allclose(chance, expected, rtol=5e-3)
    # Of few pixels and an error of some, where one pixel counts.
    places = np.array([-4.0, 0.0, 7.0, 38.0, 41.0])
    narrow = [quad(norm(x, 2.5).pdf, 0.0, 39.0, points=[0.0, 39.0])[0] for x in places]
    assert suggestions._inside(np.append(places, np.nan), 40, 2.5) == pytest.approx([*narrow, 0.0], abs=1e-8)


ROTATED = rasterio.Affine(1.9, 0.7, 4e5, 0.6, -2.3, 5e6)  # m; rows and columns of different lengths


def ramp(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A brightness that shows any shift of a map, DN; its mean over a pixel is that of the middle."""
    return 0.05 * (x - 4e5) + 0.13 * (y - 5e6) + 200.0


def brightness_where_pixels_lie(window: RasterWindow) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.indices(window.values.shape) + 0.5
    a, b, c, d, e, f = window.transform
    return window.values, ramp(a * columns + b * rows + c, d * columns + e * rows + f)


def test_pixels_of_a_window_lie_where_its_map_puts_them(tmp_path: Path) -> None:
    rows, columns = np.indices((90, 120)) + 0.5
    file = open_raster(
        write(tmp_path / "r.tif", ramp(*(ROTATED @ (columns, rows))).astype(np.float32), transform=ROTATED)
    )
    for step, size in ((1, (31, 23)), (2, (40, 24)), (4, (36, 60)), (4, (5, 60))):
        found, expected = brightness_where_pixels_lie(file.window(11, 5, *size, step))
        assert found.shape == (-(-size[1] // step), -(-size[0] // step))
        # DN: single precision; where pixels are cut, the weights of their parts, good to 1/20 of a pixel
        np.testing.assert_allclose(found, expected, atol=1e-4 if size[0] % step == 0 else 0.015)
    # on turned pixels of its own size, and on those three times as large, of which means are taken
    for scale in (1.0, 3.0):
        turned = rasterio.Affine.translation(400090.0, 4999930.0) @ rasterio.Affine.rotation(-20.0)
        there = turned @ rasterio.Affine.scale(2.1 * scale, -1.8 * scale)
        like = RasterWindow(np.zeros((14, 9), np.float32), tuple(there)[:6], file.crs)
        found, expected = brightness_where_pixels_lie(file.resampled(like))
        # GDAL stretches its cubic kernel where pixels become larger, here by a tenth and less: a ramp of 0.17
        # and 0.26 DN a pixel, of means three times that, is then off by a tenth of a pixel, its mean not
        assert np.abs(found - expected).max() < (0.01 if scale == 1.0 else 0.08)
        assert abs((found - expected).mean()) < 2e-3
    beyond = RasterWindow(np.zeros((14, 9), np.float32), (2.0, 0.0, 3.9e5, 0.0, -2.0, 5e6), file.crs)
    assert np.isnan(file.resampled(beyond).values).all()


@pytest.mark.parametrize(("sigma_px", "most_px"), [(0.1, 1.0), (0.6, 1.8)])
def test_a_match_is_of_the_same_thing_up_to_1_px_and_3_sigma_beyond_what_the_dates_have_in_common(
    sigma_px: float, most_px: float
) -> None:
    pixel_m = np.array([[1.9, 0.7], [0.6, -2.3]])
    common_px, towards = np.array([2.0, -3.0]), np.array([0.6, -0.8])
    for off_px, others, kept in ((most_px - 0.01, 2, True), (most_px + 0.01, 2, False), (0.1, 3, False)):
        one = suggestions.Again("old", common_px + off_px * towards, sigma_px)
        place = suggestions.Candidate(
            target_id="t",
            ortho=Of(label="new"),
            place=None,
            lat_deg=45.0,
            lon_deg=13.0,
            height_m=0.0,
            height_kind="egm96",
            p_e=np.zeros(3),
            pixel_m=pixel_m,
            stated_m=(1.0, 1.0),
            others=others,
            again=(one,),
        )
        found = suggestions._stable(place, {("new", "old"): pixel_m @ common_px})
        assert (found is not None) == kept
        if found:
            assert found.again[0].offset_px == pytest.approx(off_px * towards, abs=1e-12)
        # Of a date without places enough, the match itself is what both have in common.
        alone = suggestions._stable(place, {})
        assert (alone is not None) == (others == 2)
        assert alone is None or alone.again[0].offset_px == pytest.approx([0.0, 0.0], abs=1e-12)


def test_a_reference_an_image_is_as_far_off_as_its_dates_scatter_and_has_an_id_that_a_dump_takes() -> None:
    long = "a b/c" * 20
    offsets = {("x", "y"): [3.0, -1.0], ("x", "z"): [1.0, 4.0], (long, "x"): [0.0, 2.0]}
    offsets |= {(f"{long}2", "x"): [8.0, 0.0]}  # begins alike
    found = suggestions.Suggestion((), None, (), {of: np.array(m) for of, m in offsets.items()}, ())
    references = found.references("ortho", None, 7.0)
    # the image's own place is one more date, of no offset; standard deviations of both axes, m
    dates = {"x": [[0.0, 3.0, 1.0], [0.0, -1.0, 4.0]], long: [[0.0, 0.0], [0.0, 2.0]]}
    for label, axes in dates.items():
        one, (east, north) = references[label], map(stdev, axes)
        scatter = np.hypot(east, north) / np.sqrt(2.0)
        assert (one.sigma_east_m, one.sigma_north_m, one.sigma_up_m) == pytest.approx((scatter, scatter, 7.0))
    assert references["x"].id == "ortho-x"
    # the longest that the format of a dump takes
    assert len(references[long].id) == 64 and references[long].id.startswith("ortho-a-b-ca-b-c")
    assert set(references) == {"x", long, f"{long}2"}
    assert len({one.id for one in references.values()}) == 3
