"""Places of KML beside those that they were made from."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
from lopsided import PLACES
from orbiting_camera import NOTES
from test_ground_points import POINTS

from boresight.features.exports.kml import kml_text

KML = "{http://www.opengis.net/kml/2.2}"


def test_kml_has_longitude_before_latitude_and_the_height_of_each_target() -> None:
    lat, lon, height = np.array(list(PLACES.values())).T
    table = {"lat_deg": lat, "lon_deg": lon, "height_m": height, "used": np.array([True, False, True])}
    points = replace(POINTS, target_id=tuple(PLACES), **table)
    outline = np.column_stack([lon, lat])
    root = ElementTree.fromstring(kml_text({"S": outline}, [points], NOTES))
    marks = {mark.findtext(f"{KML}name"): mark for mark in root.iter(f"{KML}Placemark")}
    for name, (latitude, longitude, above) in PLACES.items():
        text = marks[name].findtext(f"{KML}Point/{KML}coordinates")
        assert [float(value) for value in text.split(",")] == [longitude, latitude, above]
        assert marks[name].findtext(f"{KML}styleUrl") == ("#rejected" if name == "Walvis" else "#used")
    ring = marks["S"].findtext(f".//{KML}LinearRing/{KML}coordinates").split()
    corners = [tuple(map(float, corner.split(",")[:2])) for corner in ring[:-1]]
    assert corners == list(map(tuple, outline.tolist()))
    assert ring[0] == ring[-1]
