"""Targets from a STAC catalogue: dates, clouds, offsets between dates; on a disk, in a store, from an API."""

import http.server
import json
import threading
import tomllib
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace as Of

import numpy as np
import pystac
import pytest
import rasterio
from command_line import ran
from edits import rows_of
from pyproj import Transformer
from scipy.ndimage import gaussian_filter, shift
from stored import bucket_served

from boresight.features.targets.stac_items import StacQuery, _image, _is_wanted, stac_images
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.object_store import dump_folder

EPSG, PIXEL_M, EAST, NORTH, SIDE = 32633, 2.0, 4e5, 5e6, 360
PAIRS = Path(__file__).resolve().parents[4] / "shared" / "data" / "pairs"
# Offsets of the dates, (row, column) px of the image against its map, and the columns that a cloud covers.
DATES = {
    "2021-06-01": ((0.0, 0.0), slice(0, 120)),
    "2020-06-01": ((1.5, -0.5), None),
    "2019-06-01": ((-0.75, 1.0), None),
}


def raster(path: Path, values: np.ndarray, pixel_m: float = PIXEL_M) -> Path:
    transform = rasterio.Affine(pixel_m, 0, EAST, 0, -pixel_m, NORTH)
    size = {"count": 1, "height": values.shape[0], "width": values.shape[1], "dtype": values.dtype}
    with rasterio.open(
        path, "w", driver="GTiff", crs=f"EPSG:{EPSG}", transform=transform, tiled=True, **size
    ) as file:
        file.write(values, 1)
    return path


def catalogue_of(folder: Path, images: dict[str, dict[str, Path]], base: str | None = None) -> Path:
    """A static catalogue of an item a date; its assets lie beside it, or at the address `base`."""
    to_degrees = Transformer.from_crs(EPSG, 4326, always_xy=True)
    west, south, east, north = to_degrees.transform_bounds(EAST, NORTH - 720, EAST + 720, NORTH)
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    catalogue = pystac.Catalog(id="c", description="images of one place")
    for date, files in images.items():
        taken = datetime.fromisoformat(date).replace(hour=10, tzinfo=UTC)
        geometry = {"type": "Polygon", "coordinates": [ring]}
        item = pystac.Item(date, geometry, [west, south, east, north], taken, properties={})
        item.add_asset("aot", pystac.Asset("aot.tif", media_type=pystac.MediaType.COG, roles=["other"]))
        for name, path in files.items():
            href = str(path) if base is None else f"{base}/{path.name}"
            roles = ["data"] if name == "image" else []
            item.add_asset(name, pystac.Asset(href, media_type=pystac.MediaType.COG, roles=roles))
        catalogue.add_item(item)
    catalogue.normalize_and_save(str(folder), pystac.CatalogType.SELF_CONTAINED)
    return folder / "catalog.json"


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Path]]:
    """Of one ground three dates, the oldest with another east; a scene classification of the newest."""
    folder = tmp_path_factory.mktemp("images")
    rng = np.random.default_rng(3)
    ground = gaussian_filter(rng.normal(size=(SIDE, SIDE)), 1.5) * 400.0
    other = gaussian_filter(rng.normal(size=(SIDE, SIDE)), 1.5) * 400.0
    found: dict[str, dict[str, Path]] = {}
    for date, (offset, cloud) in DATES.items():
        shown = ground.copy()
        if date != "2021-06-01":
            shown[:, 270:] = other[:, 270:]  # the east is another one in the older images
        shown = shift(shown, offset, order=3, mode="nearest") + rng.normal(0.0, 1.0, ground.shape)
        if cloud is not None:
            shown[:, cloud] = other[:, cloud]
        values = np.clip(shown * 0.5 + 128.0, 0, 255).astype(np.uint8)
        found[date] = {"image": raster(folder / f"{date}.tif", values)}
        classes = np.full((SIDE // 2, SIDE // 2), 4, dtype=np.uint8)  # 4 m: vegetation, and cloud
        if cloud is not None:
            classes[:, slice(cloud.start // 2, cloud.stop // 2)] = 9
        found[date]["SCL"] = raster(folder / f"{date}-scl.tif", classes, 2 * PIXEL_M)
    return found


def suggested(out: Path, *words: object) -> tuple[list[dict[str, str]], str]:
    given = ("targets", "suggest", "--height-m", 300, "--out", out, "--size-px", 64, "--most", 12)
    told = ran(*given, *words).output
    return rows_of(out / "targets.csv"), told


def columns_of(rows: list[dict[str, str]]) -> np.ndarray:
    """Columns of the images that the targets lie in."""
    to_map = Transformer.from_crs(4326, EPSG, always_xy=True)
    east = to_map.transform([float(r["lon_deg"]) for r in rows], [float(r["lat_deg"]) for r in rows])[0]
    return (np.asarray(east) - EAST) / PIXEL_M


def test_newest_clear_image_gives_the_chips_and_changed_places_none(images, tmp_path):
    rows, output = suggested(tmp_path / "t", "--stac", catalogue_of(tmp_path / "c", images).parent)
    columns, references = columns_of(rows), [row["reference"] for row in rows]
    assert len(rows) >= 8 and columns.max() < 270 + 32  # a chip may reach over the border by its half
    assert set(references) == {"ortho-2021-06-01", "ortho-2020-06-01"}
    for column, reference in zip(columns, references):
        assert (column > 120 + 31) == (reference == "ortho-2021-06-01")  # whole chips without cloud
    assert "found again in 2 of 2 images of other dates" in output


def test_scatter_of_the_dates_offsets_is_the_sigma_of_the_ground_reference(images, tmp_path):
    _, output = suggested(tmp_path / "t", "--stac", catalogue_of(tmp_path / "c", images))
    # -0.5 px of 2 m to the east and 1.5 px down: the images' noise leaves 0.01 px
    (line,) = [line for line in output.splitlines() if line.startswith("2020-06-01 against 2021-06-01")]
    east, north = (float(word) for word in line.split() if word[0] in "+-")
    assert (east, north) == pytest.approx((-1.0, -3.0), abs=0.1)  # m: 0.05 px
    tables = tomllib.loads((tmp_path / "t" / "ground_references.toml").read_text())["ground_references"]
    newest = next(table for table in tables if table["id"] == "ortho-2021-06-01")
    offsets = PIXEL_M * np.array([offset for offset, _ in DATES.values()])
    expected = np.sqrt(offsets.var(axis=0, ddof=1).mean())  # 2.0 m
    assert newest["sigma_east_m"] == newest["sigma_north_m"] == pytest.approx(expected, abs=0.1)


def test_items_are_taken_by_day_place_and_asset(images: dict[str, dict[str, Path]], tmp_path: Path) -> None:
    catalogue = catalogue_of(tmp_path / "c", images)
    every, unused = stac_images(StacQuery(source=catalogue))
    assert [one.day for one in every] == sorted(DATES, reverse=True) and unused == []
    late, _ = stac_images(StacQuery(source=catalogue, days="2020-01-01/2020-12-31"))
    assert [one.label for one in late] == ["2020-06-01"]
    for wanted in ({"bbox": (0.0, 0.0, 1.0, 1.0)}, {"days": "2022-01-01/"}):
        with pytest.raises(RawDataError, match="no item of that place and time"):
            stac_images(StacQuery(source=catalogue, **wanted))
    with pytest.raises(RawDataError, match="found aot, image, SCL, expected red"):
        stac_images(StacQuery(source=catalogue, asset="red"))
    (catalogue.parent / "2020-06-01" / "2020-06-01.json").write_text("{}")
    with pytest.raises(RawDataError, match=r"catalog\.json: catalogue"):
        stac_images(StacQuery(source=catalogue))


def test_item_whose_image_is_missing_is_named_and_the_others_are_used(images, tmp_path):
    lost = images | {"2018-06-01": {"image": tmp_path / "lost.tif"}}
    found, (line,) = stac_images(StacQuery(source=catalogue_of(tmp_path / "c", lost)))
    assert len(found) == 3 and line.startswith("2018-06-01: ") and "lost.tif" in line


@pytest.fixture(scope="module")
def store(images: dict[str, dict[str, Path]], tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a server of objects with a catalogue in its bucket `archive`, of assets by `http://`."""
    with bucket_served() as (address, files):
        folder = catalogue_of(tmp_path_factory.mktemp("stored"), images, f"{address}/archive").parent
        for path in folder.rglob("*.json"):
            files.put(str(path), f"archive/c/{path.relative_to(folder)}")
        for path in (file for of in images.values() for file in of.values()):
            files.put(str(path), f"archive/{path.name}")
        yield address


def test_stores_and_disks_give_the_same_targets(store, images, tmp_path):
    dates = sorted(DATES, reverse=True)[:2]
    here = suggested(tmp_path / "here", *(images[date]["image"] for date in dates))[0]
    assert len(here) >= 6  # places of which half has changed are not found again
    assert suggested(tmp_path / "there", *(f"{store}/archive/{date}.tif" for date in dates))[0] == here
    local, _ = stac_images(StacQuery(source=catalogue_of(tmp_path / "c", images)))
    for source in ("s3://archive/c/catalog.json", f"{store}/archive/c/catalog.json"):
        stored, _ = stac_images(StacQuery(source=dump_folder(source)))
        for one, other in zip(local, stored, strict=True):
            # of the newest 20 columns clouded
            windows = [file.window(100, 0, 60, SIDE) for file in (one, other)]
            np.testing.assert_array_equal(*(window.values for window in windows))
            assert one.day == other.day and np.isnan(windows[0].values).mean() in (0.0, 1.0 / 3.0)


def test_catalogue_in_a_store_names_no_file_of_this_machine(store: str) -> None:
    import fsspec

    files = fsspec.filesystem("s3", skip_instance_cache=True)
    item = json.loads(files.cat("archive/c/2020-06-01/2020-06-01.json"))
    item["links"] = []
    refused = {"file:///etc/hosts": "href: found", "ftp://host/a.tif": "href: found"}
    refused["/etc/hosts"] = r"s3://archive/etc/hosts: file: found no such file"  # a path of the store
    for n, (href, message) in enumerate(refused.items()):
        item["assets"]["image"]["href"] = href
        files.pipe(f"archive/{n}.json", json.dumps(item).encode())
        with pytest.raises(RawDataError, match=message):
            stac_images(StacQuery(source=dump_folder(f"s3://archive/{n}.json")))


def test_api_is_searched(images: dict[str, dict[str, Path]], tmp_path: Path) -> None:
    catalogue = catalogue_of(tmp_path / "c", images)
    items = [json.loads((catalogue.parent / date / f"{date}.json").read_text()) for date in DATES]
    asked: list[str] = []

    class Api(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.answer({})

        def do_HEAD(self) -> None:
            self.answer({}, head=True)

        def do_POST(self) -> None:
            self.answer(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))

        def answer(self, wanted: dict, head: bool = False) -> None:
            here = f"http://127.0.0.1:{self.server.server_port}"
            search = {"rel": "search", "href": f"{here}/search", "method": "POST"}
            search["type"] = "application/geo+json"
            root = {"type": "Catalog", "id": "api", "stac_version": "1.0.0", "description": "api"}
            kinds = ["https://api.stacspec.org/v1.0.0/core", "https://api.stacspec.org/v1.0.0/item-search"]
            content = root | {"conformsTo": kinds, "links": [search]}
            if "search" in self.path:
                asked.append(wanted["datetime"])
                found = [item | {"links": []} for item in items if item["id"] > "2020"]
                content = {"type": "FeatureCollection", "features": found, "links": []}
            body = json.dumps(content).encode()
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(b"" if head else body)

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Api) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        source = dump_folder(f"http://127.0.0.1:{server.server_port}/")
        with pytest.raises(
            RawDataError, match="an address, as the catalogue has"
        ):  # its assets lie on this disk
            stac_images(StacQuery(source=source, days="2020-01-01/2021-12-31"))
        server.shutdown()
    assert asked == ["2020-01-01T00:00:00Z/2021-12-31T23:59:59Z"]


def test_years_of_real_aerial_images_give_ten_targets(tmp_path: Path) -> None:
    years = ("20190904", "20170827", "20150926")
    files = {f"{y[:4]}-{y[4:6]}-{y[6:]}": {"image": PAIRS / f"naip_{y}.tif"} for y in years}
    if not all(of["image"].exists() for of in files.values()):
        pytest.skip(f"THE REAL IMAGES {PAIRS} ARE NOT THERE: suggestions from them were not tested")
    catalogue = catalogue_of(tmp_path / "c", files)
    rows, _ = suggested(tmp_path / "t", "--stac", catalogue, "--size-px", 96)
    assert len(rows) >= 10
    assert len({row["id"] for row in rows}) == len(rows)


@pytest.mark.parametrize("with_heights", [False, True])
def test_an_item_is_wanted_where_its_box_meets_that_of_the_query_and_its_day_is_one_of_the_days(
    with_heights: bool,
) -> None:
    low, high = (10.0, 40.0), (12.0, 45.0)
    box = [*low, -100.0, *high, 9000.0] if with_heights else [*low, *high]
    item = Of(bbox=box, datetime=datetime(2020, 5, 17, 23, tzinfo=UTC))
    places = (
        np.array([9.0, 9.9, 10.1, 11.0, 11.9, 12.1, 13.0]),
        np.array([39.0, 39.9, 40.1, 43.0, 44.9, 45.1]),
    )
    for west, east in combinations(places[0], 2):
        for south, north in combinations(places[1], 2):
            x, y = (np.linspace(a, b, 201) for a, b in ((west, east), (south, north)))
            meets = ((low[0] < x) & (x < high[0])).any() and ((low[1] < y) & (y < high[1])).any()
            assert _is_wanted(item, StacQuery(bbox=(west, south, east, north))) == meets
    for days, wanted in (
        *(("", True), ("2020-05-17/2020-05-17", True), ("2020-05-18/", False), ("2020-05-17/..", True)),
        *(("/2020-05-16", False), ("../2020-05-17", True), ("2019-01-01/2021-01-01", True)),
    ):
        assert _is_wanted(item, StacQuery(days=days)) == wanted, days


def test_pixels_are_left_out_by_the_classes_named_clouds_and_by_no_others(tmp_path: Path) -> None:
    image = raster(tmp_path / "a.tif", np.full((20, 20), 100, np.uint8))
    state = np.random.default_rng(3).integers(0, 16, (20, 20)).astype(np.uint8)
    mask = raster(tmp_path / "b.tif", state)
    classes = [
        {"name": "Clear", "value": 3},
        {"name": "Thin cloud", "value": 6},
        {"name": "cloud", "value": 8},
    ]
    for extra, roles, clouded in (
        ({"classification:classes": classes}, [], np.isin(state, [6, 8])),
        ({}, ["cloud"], state != 0),  # a mask without classes
        ({}, ["other"], np.zeros((20, 20), bool)),
    ):
        item = pystac.Item("i", None, None, datetime(2020, 5, 17, tzinfo=UTC), properties={})
        item.add_asset("image", pystac.Asset(str(image), media_type=pystac.MediaType.COG, roles=["data"]))
        how = {"media_type": pystac.MediaType.COG, "roles": roles, "extra_fields": extra}
        item.add_asset("quality", pystac.Asset(str(mask), **how))
        found = _image(item, StacQuery(source=tmp_path)).window(0, 0, 20, 20)
        assert np.array_equal(np.isnan(found.values), clouded)
