"""Files that name others, on a server or on this machine: nothing is requested, nothing else is opened."""

import base64
import gzip
import io
import os
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.io.votable import from_table
from astropy.table import Table
from edits import replaced
from rasterio.transform import from_origin
from rasters import write_raster

from boresight.features.targets.ortho_files import RasterWindow, open_raster
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import content_of, open_regular
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.images.rasters import read_grid
from boresight.pipeline.files.star_tables import read_star_table
from boresight.pipeline.files.text_files import read_text, toml_tables
from boresight.pipeline.files.xml_files import read_xml

pytestmark = pytest.mark.usefixtures("ends_in_time")


@pytest.fixture
def server() -> Iterator[tuple[str, list[str]]]:
    """The address of a server, and what was requested of it."""
    requests: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            requests.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET

        def log_message(self, *_: object) -> None:
            pass

    listening = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=listening.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{listening.server_port}", requests
    listening.shutdown()
    thread.join()


def stars() -> Table:
    columns = ("ra dec pmra pmdec ra_error dec_error pmra_error pmdec_error phot_g_mean_mag").split()
    table = Table({name: np.array([0.1, 0.2]) * (n + 1) for n, name in enumerate(columns)})
    table["ref_epoch"], table["source_id"] = 2016.0, np.array([1, 2])
    return table


def votable(path: Path, kind: str) -> str:
    """A VOTable of two stars as text."""
    document = from_table(stars())
    document.get_first_table().format = kind
    document.to_xml(str(path))
    return path.read_text()


@pytest.mark.parametrize("attributes", ["", ' actuate="onLoad"', ' encoding="base64"'])
@pytest.mark.parametrize("kind", ["BINARY", "BINARY2", "FITS"])
def test_table_whose_stars_lie_elsewhere_is_refused_and_nothing_is_requested(
    kind: str, attributes: str, tmp_path: Path, server: tuple[str, list[str]]
) -> None:
    address, requests = server
    path, pipe, secret = tmp_path / "stars.vot", tmp_path / "pipe", tmp_path / "secret"
    text = votable(path, "binary")
    begin, end = text.index("<BINARY"), text.index("</BINARY>") + len("</BINARY>")
    os.mkfifo(pipe)
    secret.write_bytes(b"secret")
    for where in (f"{address}/stars", f"file://{secret}", f"file://{pipe}", str(pipe)):
        stream = f'<{kind}><STREAM href="{where}"{attributes}/></{kind}>'
        path.write_text(text[:begin] + stream + text[end:])
        with pytest.raises(RawDataError, match=r"stars.vot: STREAM: found href=") as caught:
            read_star_table(path, "stars.vot")
        assert "secret\n" not in str(caught.value)
    assert requests == []


def test_dump_with_such_a_table_is_refused_and_nothing_is_requested(handmade, server):
    address, requests = server
    text = votable(handmade / "stars.vot", "binary").replace("<STREAM", f'<STREAM href="{address}/a"')
    (handmade / "stars.vot").write_text(text)
    replaced(handmade / "dump.toml", "[files]", '[files]\nstar_catalogue = "stars.vot"')
    with pytest.raises(RawDataError, match=r"stars.vot|star_catalogue"):
        dump = open_dump(handmade)
        assert dump.star_catalogue is not None
        read_star_table(dump.star_catalogue.path, dump.star_catalogue.file)
    assert requests == []


@pytest.mark.parametrize("how", ["STREAM of gzip", "FITS of gzip"])
def test_table_that_unpacks_to_any_size_is_refused(how: str, tmp_path: Path) -> None:
    path = tmp_path / ("stars.vot" if how.startswith("STREAM") else "stars.fits")
    if path.suffix == ".vot":
        packed = base64.b64encode(gzip.compress(bytes(10**6))).decode()
        text = votable(path, "binary")
        begin, end = text.index("<STREAM"), text.index("</STREAM>")
        path.write_text(text[:begin] + f'<STREAM encoding="gzip">{packed}' + text[end:])
    else:
        stream = io.BytesIO()
        fits.HDUList([fits.PrimaryHDU(), fits.table_to_hdu(stars())]).writeto(stream)
        path.write_bytes(stream.getvalue())
        assert len(read_star_table(path, "stars").places.hip) == 2
        path.write_bytes(gzip.compress(stream.getvalue()))
    with pytest.raises(RawDataError, match=r"stars: (STREAM: found encoding=|byte 0: found 1f 8b)"):
        read_star_table(path, "stars")


@pytest.mark.parametrize(
    "text",
    [
        '<!DOCTYPE a SYSTEM "{0}/a.dtd"><a/>',
        '<!DOCTYPE a [<!ENTITY b SYSTEM "{0}/b">]><a>&b;</a>',
        '<!DOCTYPE a [<!ENTITY % b SYSTEM "{0}/b"> %b;]><a/>',
    ],
)
def test_xml_that_names_others_is_refused_and_nothing_is_requested(text, tmp_path, server):
    (tmp_path / "a.xml").write_text(text.format(server[0]))
    with pytest.raises(RawDataError, match="XML without DTD, entities or references"):
        read_xml(tmp_path / "a.xml", "a.xml")
    assert server[1] == []


def test_xml_and_toml_that_name_others_in_words_are_only_words(tmp_path, server):
    include = f'<a xmlns:xi="http://www.w3.org/2001/XInclude"><xi:include href="{server[0]}/x"/></a>'
    (tmp_path / "a.xml").write_text(include)
    assert len(read_xml(tmp_path / "a.xml", "a.xml")) == 1
    (tmp_path / "a.toml").write_text(f'include = "{server[0]}/x"\n')
    assert toml_tables(tmp_path / "a.toml", "a.toml") == {"include": f"{server[0]}/x"}
    assert server[1] == []


def chip(path: Path) -> None:
    pixels = np.arange(1280, dtype=np.uint8).reshape(32, 40)
    write_raster(path, pixels, crs="EPSG:32633", transform=from_origin(5e5, 5e6, 10.0, 10.0))


def vrt(source: str, more: str = "", tag: str = "SourceFilename") -> str:
    place = "<GeoTransform>500000, 10, 0, 5000000, 0, -10</GeoTransform><SRS>EPSG:32633</SRS>"
    body = f'<SimpleSource><{tag} relativeToVRT="1">{source}</{tag}><SourceBand>1</SourceBand></SimpleSource>'
    band = f'<VRTRasterBand dataType="Byte" band="1">{more}{body}</VRTRasterBand>'
    return f'<VRTDataset rasterXSize="40" rasterYSize="32">{place}{band}</VRTDataset>'


def test_chip_beside_sidecars_opens_none_of_them(tmp_path: Path) -> None:
    """GDAL knows a dozen names of further files beside a TIFF: were one opened, the FIFO would block."""
    path = tmp_path / "0.tif"
    chip(path)
    for name in ("0.tif.aux.xml", "0.aux", "0.tfw", "0.wld", "0.tab", "0.tif.ovr", "0.tif.msk", "0.rpb"):
        os.mkfifo(tmp_path / name)
    for name in ("0_RPC.TXT", "0.imd", "0.rrd", "0.hdr"):
        os.mkfifo(tmp_path / name)
    assert read_grid(path, "0.tif", max_pixels=10**6).values.shape == (32, 40)


def test_vrt_in_the_place_of_a_chip_is_no_tiff(tmp_path: Path, server: tuple[str, list[str]]) -> None:
    (tmp_path / "0.tif").write_text(vrt(f"/vsicurl/{server[0]}/a.tif"))
    with pytest.raises(RawDataError, match="byte 0"):
        read_grid(tmp_path / "0.tif", "0.tif", max_pixels=10**6)
    assert server[1] == []


def read_ortho(path: Path, band: int | None = None) -> RasterWindow:
    """All pixels of a raster."""
    file = open_raster(path, band)
    return file.window(0, 0, file.shape[1], file.shape[0])


def test_ortho_image_as_vrt_is_read_from_files_of_this_machine_only(tmp_path, server):
    chip(tmp_path / "a.tif")
    path = tmp_path / "a.vrt"
    path.write_text(vrt("a.tif"))
    assert read_ortho(path).values[1, 0] == 40.0
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "wms.xml").write_text(f"<GDAL_WMS><Service name='TMS'>{server[0]}</Service></GDAL_WMS>")
    on_server = (f"/vsicurl/{server[0]}/a.tif", f"{server[0]}/a.tif", f"WMS:{server[0]}/wms")
    for source in (*on_server, "wms.xml", "pipe", "missing.tif"):
        for tag in ("SourceFilename", "SourceDataset"):
            path.write_text(vrt(source, tag=tag))
            with pytest.raises(RawDataError, match=r"a\.vrt"):
                read_ortho(path)
    path.write_text(vrt("a.tif", "<PixelFunctionLanguage>Python</PixelFunctionLanguage>"))
    with pytest.raises(RawDataError, match="found code, expected a VRT without functions"):
        read_ortho(path)
    for name in ("wms.xml", "pipe"):
        with pytest.raises(RawDataError):
            read_ortho(tmp_path / name)
    assert server[1] == []


def test_only_regular_files_are_opened_and_nothing_blocks(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "null").symlink_to("/dev/null")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name in ("pipe", "null", "zero", "."):
        with pytest.raises(OSError, match="not a regular file"):
            open_regular(tmp_path / name)
        with pytest.raises(OSError, match="not a regular file"):
            content_of(tmp_path / name)
        with pytest.raises(RawDataError, match=r"a device, FIFO or socket|a folder"):
            read_text(tmp_path / name, name)


@pytest.mark.parametrize("kind", ["binary", "binary2", "tabledata"])
def test_table_that_holds_its_stars_is_read(kind: str, tmp_path: Path) -> None:
    votable(tmp_path / "stars.vot", kind)
    read, stated = read_star_table(tmp_path / "stars.vot", "stars.vot"), stars()
    assert read.places.hip.tolist() == [1, 2] and read.places.epoch_jyear == 2016.0
    np.testing.assert_allclose(np.degrees(read.places.ra_rad), stated["ra"], rtol=1e-12)
    np.testing.assert_allclose(np.degrees(read.places.dec_rad), stated["dec"], rtol=1e-12)
    mas = np.radians(1.0 / 3.6e6)
    pm_ra = read.places.pm_ra_rad_yr * np.cos(np.radians(stated["dec"])) / mas
    np.testing.assert_allclose(pm_ra, stated["pmra"], rtol=1e-9)
    np.testing.assert_allclose(read.places.pm_dec_rad_yr / mas, stated["pmdec"], rtol=1e-9)
    for sigma, name in ((read.sigma_rad, ""), (read.sigma_pm_rad_yr, "pm")):  # rms of two axes
        both = [np.asarray(stated[f"{name}{axis}_error"]) for axis in ("ra", "dec")]
        np.testing.assert_allclose((sigma / mas) ** 2, (both[0] ** 2 + both[1] ** 2) / 2.0, rtol=1e-9)
