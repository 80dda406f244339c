"""Variants that the formats allow, 40 a family of readers: is each read as the file it was made from?

    python benchmarks/conforming_files.py WORK > benchmarks/results/conforming_files.txt

WORK is the folder of real data beside the project (shared/data). Of its products (a Pleiades strip, a
Sentinel-2 datastrip with its GIPP) and of tables of points, variants are made that XML, DIMAP, the product
specification of Sentinel-2, GDAL, QGIS, ASP and others allow: encodings, namespaces, packings, forms of
numbers and times, blocks left out, and files of neighbouring programs. A variant is to be read with the same
values, or to be refused with words that name what is wrong. No file of WORK is copied into this repository.
"""

from __future__ import annotations

import argparse
import gzip
import io
import re
import sys
import tarfile
import tempfile
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from pyproj import CRS, Transformer
from rasterio.control import GroundControlPoint
from record import exit_status, head, verdict

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path.insert(0, str(TESTS))

from handmade_dimap import as_version_2  # noqa: E402

from boresight.features.operators.point_import import PointErrors, read_measured_points  # noqa: E402
from boresight.features.operators.sentinel2_product import read_sentinel2  # noqa: E402
from boresight.geometry.terrain import ConstantHeight  # noqa: E402
from boresight.pipeline.errors import RawDataError  # noqa: E402
from boresight.pipeline.files.dimap_metadata import operator_model  # noqa: E402

ASKED = 40  # variants a family
Case = tuple[str, Any, str]  # what it varies, its content, what a refusal says (empty: it is to be read)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    work = parser.parse_args().work
    sys.argv[1:] = ["WORK"]  # what the record says
    warnings.simplefilter("ignore")
    head("Variants that the formats allow")
    families = {
        "dimap": (dimap_cases(work), dimap_values),
        "datastrip": (datastrip_cases(work), sentinel2_values),
        "gipp": (gipp_cases(work), sentinel2_values),
        "points": (point_cases(), point_values),
    }
    for family, (cases, values) in families.items():
        counts = run_family(family, cases, values)
        verdict(f"{family}: {sum(counts.values())} variants, {ASKED} asked", sum(counts.values()) >= ASKED)
        verdict(
            f"{family}: {counts['WRONG']} with other values, other words or a traceback", not counts["WRONG"]
        )
        print()
    raise SystemExit(exit_status())


def run_family(family: str, cases: list[Case], values: Callable[[Any, Path], Any]) -> Counter[str]:
    """Every case in a folder of its own, compared with the first."""
    print(family)
    counts: Counter[str] = Counter()
    expected: dict[str, Any] = {}
    for n, (name, content, refusal) in enumerate(cases):
        with tempfile.TemporaryDirectory() as folder:
            kind, text, found = outcome(content, Path(folder), values)
        if kind == "read":
            base = expected.setdefault(str(content[0])[:1] if family == "dimap" else "", found)
            worst = max(
                float(np.abs(np.asarray(a) - np.asarray(b)).max()) for a, b in zip(found, base, strict=True)
            )
            text = f"{worst:.1e} from the first"
            right = not refusal and worst <= (1e-6 if n else 0.0)
        else:
            right = bool(refusal) and kind == "refused" and re.search(refusal, text) is not None
        counts[kind if right else "WRONG"] += 1
        print(f"  {name}: {kind}{'' if right else ' WRONG'}, {text}")
    print(f"  {counts['read']} read, {counts['refused']} refused")
    return counts


def outcome(content: Any, folder: Path, values: Callable[[Any, Path], Any]) -> tuple[str, str, Any]:
    try:
        return "read", "", values(content, folder)
    except RawDataError as error:
        return "refused", str(error).replace(f"{folder}/", "").replace(str(folder), "FOLDER"), None
    except Exception as error:
        return "TRACEBACK", f"{type(error).__name__}: {error}", None


# --- what XML allows ---------------------------------------------------------------------------------------


def xml_forms(raw: bytes, element: str) -> list[tuple[str, bytes, str]]:
    """The same document in other forms; `element` is the name of one that holds a number or text."""
    text = raw.decode("utf-8-sig")
    body = re.sub(r"^\s*<\?xml[^>]*\?>", "", text).lstrip()
    declared = '<?xml version="1.0" encoding="{}"?>\n'
    one = re.compile(rf"<{element}([^>/]*)>([^<]*)</{element}>")
    hit = one.search(body)
    assert hit is not None, element

    def put(inside: str) -> bytes:
        return (declared.format("UTF-8") + body[: hit.start(2)] + inside + body[hit.end(2) :]).encode()

    value = hit[2]
    return [
        ("a byte-order mark", b"\xef\xbb\xbf" + (declared.format("UTF-8") + body).encode(), ""),
        ("no declaration", body.encode(), ""),
        ("lines end with CR LF", text.replace("\r\n", "\n").replace("\n", "\r\n").encode(), ""),
        ("UTF-16 with a byte-order mark", (declared.format("UTF-16") + body).encode("utf-16"), ""),
        ("ISO 8859-1", (declared.format("ISO-8859-1") + "<!-- \xe9t\xe9 -->" + body).encode("latin-1"), ""),
        ("windows-1252", (declared.format("windows-1252") + body).encode("cp1252"), ""),
        ("US-ASCII", (declared.format("US-ASCII") + body).encode("ascii", "xmlcharrefreplace"), ""),
        ("comments", (declared.format("UTF-8") + "<!-- a -->" + body + "<!-- b -->").encode(), ""),
        ("a processing instruction", ('<?xml-stylesheet href="a.xsl"?>\n' + body).encode(), ""),
        ("no white space between elements", re.sub(r">\s+<", "><", body).encode(), ""),
        ("attributes in single quotes", re.sub(r'="([^"\']*)"', r"='\1'", body).encode(), ""),
        (
            "attributes in reverse order",
            re.sub(r"<(\w[\w:]*)((?: [\w:]+=\"[^\"]*\")+)", _reversed, body).encode(),
            "",
        ),
        ("white space around the text", put(f"\n\t {value} \n"), ""),
        ("CDATA", put(f"<![CDATA[{value}]]>"), ""),
        ("character references", put("".join(f"&#{ord(c)};" for c in value)), ""),
        ("a comment inside the text", put(f"<!-- c -->{value}"), ""),
        ("a document type", (declared.format("UTF-8") + "<!DOCTYPE a>" + body).encode(), "XML without DTD"),
        ("an entity", ("<!DOCTYPE a [<!ENTITY b 'c'>]>" + body).encode(), "XML without DTD"),
        ("cut after two thirds", text[: 2 * len(text) // 3].encode(), "expected well-formed XML"),
        ("empty", b"", "expected"),
        (f"{element} empty", put(""), element),
        (f"{element} is text", put("x"), f"{element}|found x|{element.rpartition('_')[2]}"),
    ]


def _reversed(match: re.Match[str]) -> str:
    attributes = re.findall(r' [\w:]+="[^"]*"', match[2])
    return f"<{match[1]}" + "".join(reversed(attributes))


def without(text: str, element: str) -> str:
    """A document without every element of that name."""
    return re.sub(rf"<{element}\b[^>]*?(?:/>|>.*?</{element}>)", "", text, flags=re.DOTALL)


def numbers_as(text: str, element: str, form: Callable[[float], str]) -> str:
    """A document with the numbers of the elements of that name in another form."""

    def changed(match: re.Match[str]) -> str:
        return match[1] + " ".join(form(float(word)) for word in match[2].split()) + match[3]

    return re.sub(rf"(<{element}\b[^>]*>)([^<]*)(</{element}>)", changed, text)


# --- DIMAP ----------------------------------------------------------------------------


def dimap_values(content: tuple[str, bytes], folder: Path) -> list[Any]:
    """Places on the ground of some pixels, m."""
    path = folder / "product.xml"
    path.write_bytes(content[1])
    strip = operator_model(path)
    samples, lines = np.array([0.0, 1e4, 39_000.0]), np.array([0.0, 3e4, 11.5])
    places = strip.pushbroom.ground_points(0, samples, lines, ConstantHeight(100.0))
    return [places, [strip.width_px, strip.height_px]]


def dimap_cases(work: Path) -> list[Case]:
    raw = next((work / "pleiades").glob("PHRDIMAP*.XML")).read_bytes()
    first = raw.decode("utf-8-sig")
    second, listed = as_version_2(first), as_version_2(first, listed=True)
    cases: list[Case] = [("V1 as it came", ("1", raw), "")]
    cases += [(f"V1, {name}", ("1", form), told) for name, form, told in xml_forms(raw, "NCOLS")]
    cases += [("V2, the same product", ("2", second.encode()), "")]
    cases += [(f"V2, {name}", ("2", form), told) for name, form, told in xml_forms(second.encode(), "START")]
    root = "<Dimap_Document>"
    spaces = {
        "a default namespace": '<Dimap_Document xmlns="http://example.org/dimap">',
        "schemaLocation": '<Dimap_Document xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
        'xsi:schemaLocation="DIMAP DIMAP.xsd">',
    }
    cases += [(f"V2, {name}", ("2", second.replace(root, tag).encode()), "") for name, tag in spaces.items()]
    forms = {
        "with exponents": lambda v: f"{v:.17e}",
        "with E and a sign": lambda v: f"{v:+.17E}",
        "with zeros behind": lambda v: f"{v!r}{'' if 'e' in repr(v) else '000'}",
    }
    for name, form in forms.items():
        cases.append(
            (f"V1, positions {name}", ("1", numbers_as(first, "LOCATION_VALUES", form).encode()), "")
        )
        cases.append((f"V2, positions {name}", ("2", numbers_as(second, "LOCATION_XYZ", form).encode()), ""))
    stamps = re.sub(r"(<UTC_TIME>[^<]*?)Z?(</UTC_TIME>)", r"\1Z\2", first)
    cases += [
        ("V1, times end with Z", ("1", stamps.encode()), ""),
        ("V1, times without Z", ("1", stamps.replace("Z</UTC_TIME>", "</UTC_TIME>").encode()), ""),
        ("V2, a list of quaternions (SPOT, Neo)", ("3", listed.encode()), ""),
        ("V2, the period in microseconds", ("2", as_version_2(first, microseconds=True).encode()), ""),
        ("V2, columns counted from 101", ("2", as_version_2(first, first_col=101).encode()), ""),
    ]
    for element in (
        "NCOLS",
        "NROWS",
        "SENSOR_LINE_PERIOD",
        "Sensor_Ephemeris",
        "Sensor_Attitudes",
        "DATASET_NAME",
    ):
        cases.append((f"V1 without {element}", ("1", without(first, element).encode()), element))
    for element in ("LINE_PERIOD", "Point_List", "Attitudes", "Polynomial_Look_Angles", "Refined_Model"):
        cases.append(
            (f"V2 without {element}", ("2", without(second, element).encode()), f"{element}|Quaternion|LOS")
        )
    rpc = "<Dimap_Document><Rational_Function_Model/></Dimap_Document>"
    cases += [
        ("a file of RPC", ("2", rpc.encode()), "a file of RPC has no rigorous model"),
        (
            "SPOT 5 (DIMAP 1.1)",
            ("2", b"<Dimap_Document><MISSION>SPOT</MISSION></Dimap_Document>"),
            "not SPOT 1 to 5",
        ),
        ("a volume's index", ("2", b"<VOL/>"), "root element: found VOL"),
        ("compressed with gzip", ("1", gzip.compress(raw)), ""),
        ("gzip, cut", ("1", gzip.compress(raw)[:-100]), "gzip|well-formed"),
    ]
    return cases


# --- Sentinel-2 ----------------------------------------------------------------------------


def sentinel2_values(content: dict[str, bytes], folder: Path) -> list[Any]:
    """What the datastrip and its GIPP say, as arrays."""
    for name, raw in content.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(raw)
    gipp = next((folder / n for n in content if n.startswith("all.")), folder)
    strip = read_sentinel2(folder / "datastrip.xml", gipp, "B04")
    looks = [strip.camera.directions_from_pixels(k, np.array([0.0, 1300.5, 2500.0])) for k in (0, 5, 11)]
    trackers = [one.R_is.as_quat(canonical=True).sum(axis=0) for one in strip.trackers.values()]
    return [
        strip.positions_m.sum(axis=0) * 1e-9,
        strip.t_first_row_s,
        strip.row_period_s,
        strip.mounting_angles_rad,
        np.array(looks),
        np.array(trackers),
        strip.corrected.R_is.as_quat(canonical=True).sum(axis=0),
    ]


def _products(work: Path) -> tuple[bytes, dict[str, bytes]]:
    place = work / "sentinel2"
    gipp = {path.name: path.read_bytes() for path in sorted(place.glob("*_GIP_*.xml"))}
    return next(place.glob("*_MTD_L1B_DS_*.xml")).read_bytes(), gipp


def datastrip_cases(work: Path) -> list[Case]:
    raw, gipp = _products(work)
    text = raw.decode()

    def case(name: str, changed: str | bytes, told: str = "") -> Case:
        return (
            name,
            {"datastrip.xml": changed if isinstance(changed, bytes) else changed.encode(), **gipp},
            told,
        )

    cases = [case("as it came", raw)]
    cases += [case(*one) for one in xml_forms(raw, "LINE_PERIOD")]
    cases += [
        case("another prefix of the namespace", re.sub(r"(</?|xmlns:)n1\b", r"\1psd", text)),
        case("another version of the namespace", text.replace("psd-15.", "psd-14.")),
        case("a default namespace", re.sub(r"(</?)n1:", r"\1", text.replace("xmlns:n1=", "xmlns="))),
        case("no namespace", re.sub(r"(</?)n1:", r"\1", re.sub(r' xmlns:n1="[^"]*"', "", text))),
        case("no schemaLocation", re.sub(r' xsi:schemaLocation="[^"]*"', "", text)),
        case("times to the microsecond", re.sub(r"(\d\.\d{3})Z</DATASTRIP", r"\g<1>000Z</DATASTRIP", text)),
    ]
    for element in (
        "Downlink_Info",
        "Archiving_Info",
        "Processing_Info",
        "Quality_Indicators_Info",
        "ANGULAR_RATE",
    ):
        cases.append(case(f"without {element}", without(text, element)))
    for name, form in {
        "with exponents": lambda v: f"{v:.17e}",
        "with E and a sign": lambda v: f"{v:+.17E}",
    }.items():
        cases.append(case(f"quaternions {name}", numbers_as(text, "QUATERNION_VALUES", form)))
    needed = (
        "DATASTRIP_SENSING_START",
        "Time_Stamp",
        "GPS_Points_List|Ephemeris|GPS",
        "Corrected_Attitudes|ATT",
        "Spectral_Information_List",
        "IERS_Bulletin",
        "GIPP_List",
    )
    for one in needed:
        element = one.split("|")[0]
        if f"<{element}" in text:
            cases.append(
                case(
                    f"without {element}", without(text, element), f"{one}|Spectral|GIPP|IERS|Detector|PERIOD"
                )
            )
    cases += [
        case("level 1A", re.sub(r"(</?n1:)Level-1B", r"\1Level-1A", text), "root element: found Level-1A"),
        case("level 1C", re.sub(r"(</?n1:)Level-1B", r"\1Level-1C", text), "root element: found Level-1C"),
        case(
            "bands without B04", text.replace('physicalBand="B4"', 'physicalBand="B99"'), "expected band B04"
        ),
        case(
            "a reference line of 2",
            text.replace("<REFERENCE_LINE>1<", "<REFERENCE_LINE>2<"),
            "expected line 1",
        ),
        case("compressed with gzip", gzip.compress(raw)),
    ]
    return cases


def _tar(files: dict[str, bytes], mode: str) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode=mode) as archive:
        for name, raw in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(raw)
            archive.addfile(member, io.BytesIO(raw))
    return out.getvalue()


def _zip(files: dict[str, bytes], kind: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", kind) as archive:
        for name, raw in files.items():
            archive.writestr(name, raw)
    return out.getvalue()


def _block(raw: bytes) -> bytes:
    """A file of an Earth Explorer: the XML in the data block."""
    body = re.sub(rb"^\s*<\?xml[^>]*\?>", b"", raw)
    header = b"<Earth_Explorer_Header><Fixed_Header/></Earth_Explorer_Header>"
    return (
        b'<?xml version="1.0"?><Earth_Explorer_File>'
        + header
        + b"<Data_Block>"
        + body
        + b"</Data_Block></Earth_Explorer_File>"
    )


def gipp_cases(work: Path) -> list[Case]:
    raw, files = _products(work)
    text = {name: one.decode("utf-8-sig") for name, one in files.items()}
    looks = next(name for name in files if "VIEDIR" in name and name.endswith("B04.xml"))
    model = next(name for name in files if "SPAMOD" in name)

    def case(name: str, changed: dict[str, bytes], told: str = "") -> Case:
        return name, {"datastrip.xml": raw, **changed}, told

    def put(name: str, changed: bytes | str) -> dict[str, bytes]:
        return files | {name: changed if isinstance(changed, bytes) else changed.encode()}

    stem = {name: name.removesuffix(".xml") for name in files}
    header = b"<Earth_Explorer_Header/>"
    dbl = {f"{stem[n]}.DBL": one for n, one in files.items()} | {f"{stem[n]}.HDR": header for n in files}
    cases = [
        case("as they came", files),
        case("without the other band", {n: one for n, one in files.items() if not n.endswith("B02.xml")}),
        case("DBL and HDR", dbl),
        case("DBL alone", {n: one for n, one in dbl.items() if n.endswith("DBL")}),
        case("Earth Explorer files with a data block", {n: _block(one) for n, one in files.items()}),
        case("data blocks as DBL", {f"{stem[n]}.DBL": _block(one) for n, one in files.items()}),
        case("each in a folder of its name", {f"{stem[n]}/{n}": one for n, one in files.items()}),
        case("DBL in folders", {f"{n.rpartition('.')[0]}/{n}": one for n, one in dbl.items()}),
    ]
    for ending, mode in {"TGZ": "w:gz", "tgz": "w:gz", "tar.gz": "w:gz", "tar": "w"}.items():
        packed = {f"{stem[n]}.{ending}": _tar({n: one}, mode) for n, one in files.items()}
        cases.append(case(f"each as .{ending}", packed))
    pairs = {
        f"{stem[n]}.TGZ": _tar({f"{stem[n]}.DBL": one, f"{stem[n]}.HDR": header}, "w:gz")
        for n, one in files.items()
    }
    folders = {f"{stem[n]}.zip": _zip({f"{stem[n]}/{n}": one}) for n, one in files.items()}
    cases += [
        case("each as .TGZ of DBL and HDR", pairs),
        case("each as .zip", {f"{stem[n]}.zip": _zip({n: one}) for n, one in files.items()}),
        case("each as .zip of a folder", folders),
        case(
            "each as .zip, stored",
            {f"{stem[n]}.zip": _zip({n: one}, zipfile.ZIP_STORED) for n, one in files.items()},
        ),
        case("one archive all.tar.gz", {"all.tar.gz": _tar(files, "w:gz")}),
        case("one archive all.tar", {"all.tar": _tar(files, "w")}),
        case("one archive all.zip", {"all.zip": _zip(files)}),
        case("one archive of archives", {"all.tar": _tar(pairs, "w")}),
        case(
            "one zip of folders", {"all.zip": _zip({f"AUX/{stem[n]}/{n}": one for n, one in files.items()})}
        ),
    ]
    for name, form, told in xml_forms(files[looks], "NB_OF_PIXELS"):
        if name != "NB_OF_PIXELS empty":
            cases.append(case(f"VIEDIR, {name}", put(looks, form), told))
    cases += [
        case(
            "VIEDIR with exponents",
            put(looks, numbers_as(text[looks], "TAN_PSI_X_LIST", lambda v: f"{v:.17e}")),
        ),
        case("SPAMOD with a byte-order mark", put(model, b"\xef\xbb\xbf" + text[model].encode())),
        case("SPAMOD in UTF-16", put(model, re.sub(r"^\s*<\?xml[^>]*\?>", "", text[model]).encode("utf-16"))),
        case("without SPAMOD", {n: one for n, one in files.items() if n != model}, "SPAMOD"),
        case("without VIEDIR of the band", {n: one for n, one in files.items() if n != looks}, "VIEDIR"),
        case("no GIPP at all", {}, "GIP"),
        case("an archive that is none", {"all.tar.gz": b"\x1f\x8b\x08 no archive"}, "all.tar.gz|archive|GIP"),
        case("a cut archive", {"all.zip": _zip(files)[:5000]}, "all.zip|archive|GIP"),
    ]
    return cases


# --- points ----------------------------------------------------------------------------

LON_LAT_H = np.array(
    [[-16.9231415, 32.7412345, 12.0], [-16.8812345, 32.8412999, 12.0], [-17.0500001, 32.6900002, 12.0]]
)
XY = np.array([[100.25, 200.75], [1500.5, 820.125], [2400.0, 3100.375]])  # from the corner of the first pixel


def point_values(content: tuple[str, bytes], folder: Path) -> list[Any]:
    """Image points, and places in units of 1e-7 degrees and m."""
    path = folder / content[0]
    path.write_bytes(content[1])
    errors = PointErrors(
        sigma_px=0.5, sigma_m=(1.0, 1.0, 1.0), height_m=12.0 if path.suffix == ".points" else None
    )
    image = "b.tif" if b"b.tif" in content[1] else None
    found = read_measured_points(path, errors, image)
    order = np.argsort(found.xy_px[:, 0], kind="stable")
    return [found.xy_px[order], found.lat_lon_height[order]]


def _qgis(
    head: str = "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual",
    crs: str = "",
    map_xy: np.ndarray = LON_LAT_H[:, :2],
    tail: str = ",1,0,0,0",
) -> str:
    rows = [
        f"{a!r},{b!r},{x!r},{-y!r}{tail}" for (a, b), (x, y) in zip(map_xy.tolist(), XY.tolist(), strict=True)
    ]
    return "\n".join([*([f"#CRS: {crs}"] if crs else []), head, *rows]) + "\n"


def _asp(separator: str = " ", datum: str = "", second: bool = False, comment: str = "") -> str:
    rows = []
    for n, ((lon, lat, h), (x, y)) in enumerate(zip(LON_LAT_H.tolist(), XY.tolist(), strict=True)):
        cells = [n, lat, lon, h, 1, 1, 1]
        if second:
            cells += ["a.tif", 1.0, 2.0, 1, 1]
        cells += ["b.tif", x - 0.5, y - 0.5, 0.5, 0.5]
        rows.append(separator.join(map(str, cells)))
    return "\n".join([*([f"# WKT: {datum}"] if datum else []), *([comment] if comment else []), *rows]) + "\n"


def _tif(crs: str | None, heights: bool = True, driver: str = "GTiff", bigtiff: str = "NO") -> bytes:
    places = LON_LAT_H[:, :2]
    if crs not in (None, "EPSG:4326", "OGC:CRS84"):
        places = np.column_stack(Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(*places.T))
    gcps = [
        GroundControlPoint(row=y, col=x, x=a, y=b, z=12.0 if heights else 0.0, id=str(n))
        for n, ((a, b), (x, y)) in enumerate(zip(places.tolist(), XY.tolist(), strict=True))
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.tif"
        with rasterio.open(
            path, "w", driver=driver, width=4, height=4, count=1, dtype="uint8", BIGTIFF=bigtiff
        ) as out:
            out.write(np.zeros((1, 4, 4), dtype=np.uint8))
            if crs:
                out.gcps = (gcps, CRS.from_user_input(crs).to_wkt())
        return path.read_bytes()


def _projected(crs: str) -> np.ndarray:
    return np.column_stack(
        Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(*LON_LAT_H[:, :2].T)
    )


def point_cases() -> list[Case]:
    wgs, utm, mercator = (CRS.from_epsg(code) for code in (4326, 32628, 3857))
    plain = _qgis()

    def points(name: str, text: str | bytes, told: str = "") -> Case:
        return f"QGIS, {name}", ("a.points", text if isinstance(text, bytes) else text.encode()), told

    def asp(name: str, text: str, told: str = "") -> Case:
        return f"ASP, {name}", ("a.gcp", text.encode()), told

    cases = [
        points("3.26, no CRS", plain),
        points("2.0", _qgis("mapX,mapY,pixelX,pixelY,enable", tail=",1")),
        points("2.18 with residuals", _qgis("mapX,mapY,pixelX,pixelY,enable,dX,dY,residual")),
        points("without enable", _qgis("mapX,mapY,sourceX,sourceY", tail="")),
        points("CRS as WKT 2", _qgis(crs=wgs.to_wkt())),
        points("CRS as WKT 1 of GDAL", _qgis(crs=wgs.to_wkt("WKT1_GDAL"))),
        points("CRS as WKT 1 of ESRI", _qgis(crs=wgs.to_wkt("WKT1_ESRI"))),
        points("CRS as EPSG", _qgis(crs="EPSG:4326")),
        points("UTM", _qgis(crs=utm.to_wkt(), map_xy=_projected("EPSG:32628"))),
        points("Web Mercator", _qgis(crs=mercator.to_wkt(), map_xy=_projected("EPSG:3857"))),
        points("a point not enabled", plain + "1,2,3,-4,0,0,0,0\n"),
        points("empty lines", plain.replace("\n", "\n\n")),
        points("CR LF", plain.replace("\n", "\r\n")),
        points("a byte-order mark", b"\xef\xbb\xbf" + plain.encode()),
        points("no line end at the end", plain.rstrip("\n")),
        points("quoted cells", re.sub(r"(?m)^(-?[\d.]+),", r'"\1",', plain)),
        points("exponents", re.sub(r"-?\d+\.\d+", lambda m: f"{float(m[0]):.17e}", plain)),
        points("no points", "mapX,mapY,sourceX,sourceY,enable\n", "points: found none"),
        points("no header", plain.split("\n", 1)[1], "a.points"),
        points("a column missing", _qgis("mapX,mapY,sourceX,enable,dX,dY,residual,a"), "a.points"),
        points("a cell of text", plain.replace("1500.5", "x"), "found x"),
        points("decimal commas", plain.replace(".", ","), "cells"),
        points("CRS LOCAL", _qgis(crs="LOCAL"), "CRS: found LOCAL"),
        asp("spaces", _asp()),
        asp("commas", _asp(",")),
        asp("commas and spaces", _asp(", ")),
        asp("tabs", _asp("\t")),
        asp("two images", _asp(second=True)),
        asp("the datum", _asp(datum=wgs.to_wkt())),
        asp("comments", _asp(comment="# made by hand")),
        asp("CR LF", _asp().replace("\n", "\r\n")),
        asp("a projected datum", _asp(datum=utm.to_wkt()), "WKT|WGS"),
        asp("the Moon", _asp(datum=CRS.from_user_input("+proj=longlat +R=1737400").to_wkt()), "WKT|WGS"),
        asp("a line cut", _asp().rstrip("\n")[:-12] + "\n", "line 3"),
        asp("a cell of text", _asp().replace("12.0", "x", 1), "line 1, height: found x"),
        asp("empty", "", "points|expected"),
    ]
    for crs in ("EPSG:4326", "EPSG:32628", "EPSG:3857"):
        cases.append((f"GeoTIFF, GCPs in {crs}", ("a.tif", _tif(crs)), ""))
    cases += [
        ("GeoTIFF, .tiff", ("a.tiff", _tif("EPSG:4326")), ""),
        ("GeoTIFF, BigTIFF", ("a.tif", _tif("EPSG:4326", bigtiff="YES")), ""),
        ("GeoTIFF without GCPs", ("a.tif", _tif(None)), "a.tif"),
        ("GeoTIFF that is text", ("a.tif", b"text"), "a.tif"),
    ]
    names = {
        "ENVI .pts": ("a.pts", b"; ENVI Image to Map GCP File\n"),
        "OpenDroneMap gcp_list.txt": ("gcp_list.txt", b"EPSG:4326\n-16.9 32.7 12 100 200 a.tif\n"),
        "Metashape markers XML": ("markers.xml", b"<document/>"),
        "ArcGIS links CSV": ("links.csv", b"1,2,3,4\n"),
        "GeoJSON": ("a.geojson", b"{}"),
        "a GDAL VRT": ("a.vrt", b"<VRTDataset/>"),
        "MapInfo TAB": ("a.tab", b"!table\n"),
        "KML": ("a.kml", b"<kml/>"),
    }
    cases += [(name, content, r"ending: found \.\w+, expected one of") for name, content in names.items()]
    return cases


if __name__ == "__main__":
    main()
