"""`boresight export` on a real result: every format is made, and each says what the result says."""

import csv
import json
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import rasterio
import spiceypy
from astropy.io import fits
from command_line import invoked, ran
from pyproj import CRS
from pytest import approx
from recorded_numbers import assert_recorded, flat, numbers_in
from scipy.spatial.transform import Rotation

from boresight.features.exports import formats
from boresight.features.exports.formats import FORMATS
from boresight.features.exports.ground_error import ground_error
from boresight.features.exports.notes import notes_of
from boresight.features.geolocate.positions import Pixels, ground_places
from boresight.geometry.epoch import Epoch
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.files.spice_kernels import Kernels, read_ck
from boresight.pipeline.results.strip_model import open_calibrated, strip_model

MINI = Path(__file__).parents[3] / "fixtures" / "mini"


OF_ORIGIN = re.compile("COMMENT|CREATION|[#;]")
# test_dimap_product.py, test_gipp_product.py
OF_ANY_DUMP = [name for name in FORMATS if name not in ("dimap", "gipp")]


@pytest.fixture(scope="module")
def exported(finished, tmp_path_factory):
    """All formats at once, and what the command told."""
    folder = tmp_path_factory.mktemp("exports")
    first, *rest = OF_ANY_DUMP
    asked = ("export", finished[1], "--format", first, "--format", ",".join(rest), "--out", folder)
    return folder, ran(*asked)


@pytest.fixture(scope="module")
def installation(finished):
    return json.loads((finished[1] / "installation.json").read_text())


def test_every_file_is_told_with_its_size(exported):
    folder, told = exported[0], exported[1].stdout
    files = {path.name: path.stat().st_size for path in folder.iterdir()}
    assert len(told.splitlines()) == len(files)
    for name, size in files.items():
        assert any(line.endswith(f"/{name}") and f" {size} bytes" in line for line in told.splitlines())
    assert {line.split()[0] for line in told.splitlines()} == set(OF_ANY_DUMP)


def test_a_strip_of_which_some_rows_have_no_exposures_is_left_out_and_told(finished, tmp_path):
    result = tmp_path / "result"
    shutil.copytree(finished[1], result)
    table = pq.read_table(result / "sightings" / "exposures.parquet")
    first, last = open_dump(finished[0]).span_s(open_dump(finished[0]).strips[0])
    early = pc.less(table["t_s"], 0.5 * (first + last))
    place = table.column_names.index("usable")
    pq.write_table(table.set_column(place, "usable", early), result / "sightings" / "exposures.parquet")
    asked = ("export", result, "--dump", finished[0], "--format", "rpc", "--out", tmp_path)
    told = invoked(*asked)
    missing = "strip s01: star exposures do not cover all of its rows"
    assert isinstance(told.exception, DataNotSufficientError) and f"not exported: {missing}" in told.output
    virtual = ("virtual-ccd", result, "--dump", finished[0], "--out", tmp_path / "s01.tif")
    for words in (asked, virtual):
        refused = invoked(*words, "--strip", "s01").exception
        assert isinstance(refused, DataNotSufficientError) and missing in str(refused)


def test_an_rpc_that_misses_the_model_by_more_than_a_limit_is_reported(
    finished, exported, tmp_path, monkeypatch
):
    limit_px, told = formats.RPC_LIMIT_PX, r"(s01\.ccd\d) misses the rigorous model by up to (\d+\.\d\d) px"
    monkeypatch.setattr(formats, "RPC_LIMIT_PX", 1e-9)
    dump, result = finished
    shown = ran("export", result, "--dump", dump, "--format", "rpc", "--out", tmp_path).output
    misses = re.findall(told, shown)
    assert len(misses) == 4 and all(float(px) < 1.0 for _, px in misses)
    assert all((tmp_path / f"{name}_RPC.TXT").is_file() for name, _ in misses)
    assert re.findall(told, exported[1].output) == [one for one in misses if float(one[1]) > limit_px]


def test_an_rpc_states_the_error_that_its_pixels_are_to_have(finished, exported):
    calibrated = open_calibrated(*finished[::-1])
    model = strip_model(calibrated, "s01")
    samples, lines = (calibrated.dump.line_camera.n_px(0), model.strip.ccd_lines[0])
    line, sample = np.meshgrid(np.linspace(0.0, lines - 1.0, 7), np.linspace(0.0, samples - 1.0, 5))
    for ccd, path in enumerate(sorted(exported[0].glob("*_RPC.TXT"))):
        found = dict(re.findall(r"(ERR_\w+|HEIGHT_OFF): (\S+) meters", path.read_text()))
        bias_m, random_m, height_m = (float(found[key]) for key in ("ERR_BIAS", "ERR_RAND", "HEIGHT_OFF"))
        # The matrix is of this strip alone: it has taken up most of what its pixels share.
        assert 0.0 < bias_m < random_m
        error = ground_error(calibrated, model, ccd, lines, height_m)
        pixels = Pixels(np.full(line.size, ccd), sample.ravel(), line.ravel())
        places = ground_places(calibrated, model, pixels, ConstantHeight(height_m))
        expected2 = np.mean([places.sigma_along_m**2, places.sigma_across_m**2])
        assert error.bias_m**2 + error.random_m**2 == approx(expected2, rel=1e-9)
        # The file rounds to 0.1 mm; its polynomials add up to a pixel to what is random.
        assert bias_m == approx(error.bias_m, abs=6e-5)
        assert error.random_m - 6e-5 <= random_m < np.hypot(error.random_m, 5.0)


def test_a_calibration_file_has_matrix_covariance_and_dates(finished, tmp_path, installation):
    dates = ("--valid-from", "2026-03-01", "--valid-to", "2026-06-01")
    ran("export", finished[1], "--format", "calibration", "--out", tmp_path, *dates)
    content = json.loads((tmp_path / "calibration.json").read_text())
    assert content["R_cs"] == installation["R_cs"]
    assert content["covariance_rad2"] == installation["covariance_rad2"]
    dates = content["valid_from_utc"], content["valid_to_utc"]
    assert dates == ("2026-03-01T00:00:00.0Z", "2026-06-01T00:00:00.0Z")
    assert content["notes"]["use"] == " to ".join(dates)


def test_a_dump_reads_the_exported_kernels_as_the_attitudes_they_were_made_from(exported, finished):
    calibrated = open_calibrated(finished[1], None)
    name = calibrated.dump.strips[0].strip_id
    track = strip_model(calibrated, name).track
    files = ("clock.tsc", "installation.tf")
    kernels = Kernels(files=files, paths=tuple(exported[0] / file for file in files), spacecraft=None)
    ck = (exported[0] / f"{name}.bc", f"{name}.bc", calibrated.dump.epoch)
    star, remote = (read_ck(*ck, f"BORESIGHT_{one}_CAMERA", kernels) for one in ("STAR", "REMOTE"))
    t_s = star.t_s.clip(*track.span_s)  # a double of ephemeris time resolves 1.2e-7 s
    # rad: the satellite turns by 1.1e-3 rad/s, in that time by 1.3e-10
    assert (star.R_si * track.R_si(t_s).inv()).magnitude().max() < 3e-10
    turned = remote.R_si * (calibrated.result.R_cs * star.R_si).inv()
    assert turned.magnitude().max() < 1e-12 and len(t_s) > 30


def test_the_attitude_message_holds_the_cameras_attitude(exported, finished):
    calibrated = open_calibrated(finished[1], finished[0])
    name = calibrated.dump.strips[0].strip_id
    model = strip_model(calibrated, name)
    lines = (exported[0] / f"{name}.aem").read_text().splitlines()
    rows = [line.split() for line in lines[lines.index("DATA_START") + 1 : lines.index("DATA_STOP")]]
    t_s = calibrated.dump.epoch.seconds_from_utc([row[0] for row in rows])
    # Written to the nanosecond, in which the camera turns by 1e-12 rad; quaternions to 1e-15.
    u_c = np.array([0.0, 0.01, 0.99995])
    for row, t in zip(rows, t_s):
        u_i = Rotation.from_quat([float(value) for value in row[1:]]).apply(u_c)
        expected = (calibrated.result.R_cs * model.track.R_si(np.array([t]))[0]).inv().apply(u_c)
        assert u_i == approx(expected, abs=3e-12)
    ends = model.pushbroom.instants(np.array([-0.5, model.strip.lines - 0.5]))
    assert t_s[[0, -1]] == approx(ends, abs=2e-9)  # from the first edge of the image to its last
    assert isinstance(calibrated.dump.epoch, Epoch)


def test_isds_cover_all_samples_of_all_ccds(exported, finished):
    calibrated = open_calibrated(finished[1], finished[0])
    strip = calibrated.dump.strips[0]
    seen: dict[int, list[int]] = {}
    for path in exported[0].glob(f"{strip.strip_id}.ccd*.json"):
        isd = json.loads(path.read_text())
        about = isd["boresight"]
        assert about["notes"]["mission"] == calibrated.dump.mission
        if path.name.endswith(".whole.json"):
            assert about["stop_sample"] == isd["image_samples"] == strip.images.shapes[about["ccd"]][1]
            continue
        seen.setdefault(about["ccd"], []).extend(range(about["first_sample"], about["stop_sample"]))
        assert about["model_error_px"] < 0.01 and isd["image_lines"] == strip.lines
    assert {ccd: sorted(samples) for ccd, samples in seen.items()} == {
        ccd: list(range(strip.images.shapes[ccd][1])) for ccd in strip.images.ccds
    }


def test_ground_points_are_the_targets_of_the_dump(exported, finished):
    rows = {row["id"]: row for row in csv.DictReader((finished[0] / "targets.csv").open())}
    features = json.loads((exported[0] / "targets.geojson").read_text())["features"]
    assert features
    for feature in features:
        row = rows[feature["properties"]["target"]]
        lon, lat, _ = feature["geometry"]["coordinates"]
        assert (lon, lat) == approx((float(row["lon_deg"]), float(row["lat_deg"])), abs=1e-10)
    points = sum(len(path.read_text().splitlines()) - 2 for path in exported[0].glob("*.points"))
    assert points == len(features)
    used = sum(feature["properties"]["used"] for feature in features)
    lines = [line for path in exported[0].glob("*.pts") for line in path.read_text().splitlines()]
    assert sum(not line.startswith(";") for line in lines) == used


def read_notes(path: Path) -> str:
    """What the reader of a format shows of its origin: tags, header, comments, metadata."""
    if path.suffix == ".vrt":
        with rasterio.open(path) as file:
            return "\n".join(map(str, file.tags().items()))
    if path.suffix == ".fits":
        with fits.open(path) as file:
            return "\n".join(f"{card.value} {card.comment}" for unit in file for card in unit.header.cards)
    if path.suffix == ".bc":
        handle = spiceypy.dafopr(str(path))
        _, lines, _ = spiceypy.dafec(handle, 100)
        spiceypy.dafcls(handle)
        return "\n".join(lines)
    if path.suffix == ".points":
        return str(CRS.from_user_input(path.read_text().splitlines()[0].removeprefix("#CRS: ")).remarks)
    if path.suffix == ".kml":
        description = ElementTree.parse(path).find(".//{http://www.opengis.net/kml/2.2}description")
        return str(description.text if description is not None else "")
    if path.suffix in (".json", ".geojson"):
        return json.dumps(json.loads(path.read_text()), ensure_ascii=False)
    marks = {".tf": "", ".ti": "", ".tsc": "", ".aem": "COMMENT", ".acm": "COMMENT", ".gcp": "#", ".pts": ";"}
    mark, text = marks[path.suffix], path.read_text().partition("\\begindata")[0]  # KeyError: no reader known
    return "\n".join(line for line in text.splitlines() if line.startswith(mark))


def test_each_reader_shows_date_mission_dump_frames_validity_and_verdict(exported, finished):
    created = json.loads((exported[0] / "targets.geojson").read_text())["boresight"]["created"]
    notes = notes_of(finished[1], finished[0], created.removesuffix("Z")).items()
    assert len(notes["valid"]) > 40 and notes["mission"] != notes["dump"]
    numbers: dict[str, list[float]] = {}
    for path in exported[0].iterdir():
        text = path.read_text(errors="replace").partition("\\begindata\n")
        lines = [line for line in (text[2] or text[0]).splitlines() if not OF_ORIGIN.match(line)]
        if path.suffix in (".json", ".geojson") and ".ccd" not in path.name:  # ISDs: test_csm_isd.py
            numbers |= flat(path.name, json.loads(path.read_text()))
        elif path.suffix not in (".bc", ".fits", ".json", ".kml", ".vrt"):
            numbers[path.name] = numbers_in("\n".join(lines))
        if path.name.endswith("_RPC.TXT"):
            continue  # RPC00B has no place for it: it is in the VRT beside it
        shown = re.sub(r"[\s#;]+", "", read_notes(path).replace("COMMENT", ""))
        missing = [name for name, text in notes.items() if re.sub(r"[\s#;]+", "", text) not in shown]
        assert not missing, path.name
    assert_recorded("exports", numbers)


def test_gdal_reads_the_strips_with_their_gcps(exported, finished):
    """Through the VRT: pixels of the raw image, and the targets in GDAL's pixels."""
    features = json.loads((exported[0] / "targets.geojson").read_text())["features"]
    for path in exported[0].glob("*.gcp.vrt"):
        strip, ccd = path.name.split(".")[0], int(path.name.split(".")[1][3:])
        here = [f for f in features if (f["properties"]["strip"], f["properties"]["ccd"]) == (strip, ccd)]
        with rasterio.open(path) as file, rasterio.open(finished[0] / here[0]["properties"]["image"]) as raw:
            points, crs = file.gcps
            assert crs.to_epsg() == 4326 and np.array_equal(file.read(1), raw.read(1))
        by_id = {point.id: point for point in points}
        assert len(by_id) == sum(f["properties"]["used"] for f in here)
        for feature in here:
            if feature["properties"]["used"]:
                point = by_id[feature["properties"]["target"]]
                assert (point.x, point.y, point.z) == approx(feature["geometry"]["coordinates"], abs=1e-9)
                assert point.col == approx(feature["properties"]["sample"] + 0.5, abs=1e-9)
                assert point.row == approx(feature["properties"]["line"] + 0.5, abs=1e-9)


def test_ogr_reads_kml_and_geojson(exported, finished):
    pyogrio = pytest.importorskip("pyogrio", reason="PYOGRIO IS NOT INSTALLED: KML and GeoJSON were not read")
    about, _, shapes, fields = pyogrio.raw.read(exported[0] / "boresight.kml")
    features = json.loads((exported[0] / "targets.geojson").read_text())["features"]
    assert len(shapes) == 1 + len(features)
    assert pyogrio.read_info(exported[0] / "targets.geojson")["features"] == len(features)
    names = fields[[name.lower() for name in about["fields"]].index("name")]
    assert set(names) == {f["properties"]["target"] for f in features} | {features[0]["properties"]["strip"]}


def test_an_unknown_format_or_frame_name_is_wrong_usage(finished, tmp_path):
    assert "docx" in ran("export", finished[1], "--format", "docx", "--out", tmp_path, status=2).output
    ran("export", finished[1], "--format", "spice", "--spice-star-camera", "lower case", status=2)
