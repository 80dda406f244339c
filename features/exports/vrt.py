"""GDAL virtual datasets (VRT) of raw strip images: the image as it is, with an RPC or with targets as GCPs.

GDAL counts pixels from (0, 0) at the outer corner of the first pixel, and RPCs from its centre, as we do.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pyproj import CRS

from boresight.features.exports.ground_control_points import GroundPoints
from boresight.features.exports.notes import Notes, one_line
from boresight.pipeline.files.object_store import gdal_name

__all__ = ["vrt_with_gcps", "vrt_with_rpc"]

# Coordinate that GDAL gives the centre of the first pixel, px; here it is 0.
_CENTRE_OF_FIRST_PIXEL = 0.5


def vrt_with_rpc(
    image: Path, size_px: tuple[int, int], kind: str, rpc: Mapping[str, str], notes: Notes
) -> str:
    """VRT of a raw image of `size_px` (samples, lines) and GDAL type `kind`, with an RPC as GDAL names it."""
    root = _dataset(image, size_px, kind, notes)
    domain = ElementTree.SubElement(root, "Metadata", {"domain": "RPC"})
    for key, value in rpc.items():
        ElementTree.SubElement(domain, "MDI", {"key": key}).text = value
    return _text(root)


def vrt_with_gcps(
    image: Path, size_px: tuple[int, int], kind: str, points: GroundPoints, notes: Notes
) -> str:
    """VRT of a raw image with the targets that the calibration used as GCPs, heights above the ellipsoid."""
    root = _dataset(image, size_px, kind, notes)
    projection = CRS.from_epsg(4326).to_wkt("WKT1_GDAL")
    listed = ElementTree.Element("GCPList", {"Projection": projection, "dataAxisToSRSAxisMapping": "2,1"})
    root.insert(0, listed)
    for n in np.flatnonzero(points.used):
        x, y = points.xy_px[n] + _CENTRE_OF_FIRST_PIXEL
        places = {
            "Pixel": x,
            "Line": y,
            "X": points.lon_deg[n],
            "Y": points.lat_deg[n],
            "Z": points.height_m[n],
        }
        text = {key: f"{value:.10f}" for key, value in places.items()}
        ElementTree.SubElement(listed, "GCP", {"Id": one_line(points.target_id[n]), **text})
    return _text(root)


def _dataset(image: Path, size_px: tuple[int, int], kind: str, notes: Notes) -> ElementTree.Element:
    """The dataset with its one band and the notes as metadata."""
    width, height = map(str, size_px)
    root = ElementTree.Element("VRTDataset", {"rasterXSize": width, "rasterYSize": height})
    about = ElementTree.SubElement(root, "Metadata")
    for name, text in notes.items().items():
        ElementTree.SubElement(about, "MDI", {"key": f"BORESIGHT_{name.upper()}"}).text = text
    band = ElementTree.SubElement(root, "VRTRasterBand", {"dataType": kind, "band": "1"})
    source = ElementTree.SubElement(band, "SimpleSource")
    ElementTree.SubElement(source, "SourceFilename", {"relativeToVRT": "0"}).text = one_line(gdal_name(image))
    ElementTree.SubElement(source, "SourceBand").text = "1"
    window = {"xOff": "0", "yOff": "0", "xSize": width, "ySize": height}
    ElementTree.SubElement(source, "SrcRect", window)
    ElementTree.SubElement(source, "DstRect", window)
    return root


def _text(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"
