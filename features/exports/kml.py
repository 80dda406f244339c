"""KML 2.2: footprints of strips and the targets measured in them, for Google Earth and GIS.

Coordinates are WGS84 longitude, latitude, ellipsoidal height; KML has heights above EGM96, so points are
clamped to the ground and the height is in their description.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.etree import ElementTree

from boresight.features.exports.ground_control_points import GroundPoints
from boresight.features.exports.notes import Notes, one_line
from boresight.records.record import Floats

__all__ = ["kml_text"]

NAMESPACE = "http://www.opengis.net/kml/2.2"  # of OGC KML 2.2
COLOURS = {"footprint": "ff00a5ff", "used": "ff00c000", "rejected": "ff0000ff"}  # aabbggrr


def kml_text(footprints: Mapping[str, Floats], points: Sequence[GroundPoints], notes: Notes) -> str:
    """KML text: one polygon for each strip, whose outline (N, 2) is longitude and latitude in degrees, and
    one point for each measurement of a target.
    """
    root = ElementTree.Element("kml", {"xmlns": NAMESPACE})
    document = ElementTree.SubElement(root, "Document")
    _sub(document, "name", f"{notes.mission}: strips and targets")
    _sub(document, "description", "\n".join(notes.lines()))
    for name, colour in COLOURS.items():
        style = ElementTree.SubElement(document, "Style", {"id": name})
        _sub(ElementTree.SubElement(style, "IconStyle"), "color", colour)
        _sub(ElementTree.SubElement(style, "LineStyle"), "color", colour)
        _sub(ElementTree.SubElement(style, "PolyStyle"), "fill", "0")
    for strip_id, outline in footprints.items():
        mark = _placemark(document, strip_id, "footprint", "outline of the strip on the ground")
        boundary = ElementTree.SubElement(ElementTree.SubElement(mark, "Polygon"), "outerBoundaryIs")
        closed = [*outline.tolist(), outline[0].tolist()]
        text = " ".join(f"{lon:.8f},{lat:.8f},0" for lon, lat in closed)
        _sub(ElementTree.SubElement(boundary, "LinearRing"), "coordinates", text)
    for part in points:
        for n, target in enumerate(part.target_id):
            dx, dy = part.residual_px[n]
            sample, line = part.xy_px[n]
            about = f"strip {part.strip_id}, CCD {part.ccd}, sample {sample:.3f}, line {line:.3f}"
            about += f"; residual {dx:+.3f}, {dy:+.3f} px; ellipsoidal height {part.height_m[n]:.2f} m"
            mark = _placemark(document, target, "used" if part.used[n] else "rejected", about)
            text = f"{part.lon_deg[n]:.10f},{part.lat_deg[n]:.10f},{part.height_m[n]:.3f}"
            _sub(ElementTree.SubElement(mark, "Point"), "coordinates", text)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _placemark(parent: ElementTree.Element, name: str, style: str, about: str) -> ElementTree.Element:
    mark = ElementTree.SubElement(parent, "Placemark")
    _sub(mark, "name", name)
    _sub(mark, "description", about)
    _sub(mark, "styleUrl", f"#{style}")
    return mark


def _sub(parent: ElementTree.Element, tag: str, text: str) -> None:
    ElementTree.SubElement(parent, tag).text = "\n".join(one_line(line) for line in text.split("\n"))
