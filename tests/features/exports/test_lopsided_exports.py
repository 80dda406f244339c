"""Places of KML beside those that they were made from."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
from lopsided import PLACES
from orbiting_camera import NOTES
from test_ground_points import POINTS

from boresight.features.exports.ground_error import GroundError
from boresight.features.exports.kml import kml_text
from boresight.features.exports.rpc import Rpc, rpc_text

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


def test_rpc_states_the_largest_error_as_bias_and_the_rms_as_random() -> None:
    numbers = np.arange(1.0, 21.0)
    rpc = Rpc(
        offsets=np.array([10.0, 20.0, -54.8, -68.3, 21.5]),
        scales=np.array([1.0, 2.0, 3.0, 4.0, 5.0]),
        line_num=numbers,
        line_den=numbers + 0.25,
        sample_num=-numbers,
        sample_den=0.5 * numbers,
    )
    lines = rpc_text(rpc, GroundError(bias_m=0.75, random_m=0.25)).splitlines()
    read = dict(line.split(": ") for line in lines if ": " in line)
    assert read["ERR_BIAS"] == "0.7500 meters" and read["ERR_RAND"] == "0.2500 meters"
    assert [float(read[f"{name}_OFF"].split()[0]) for name in ("LINE", "SAMP", "LAT", "LONG", "HEIGHT")] == [
        *(10.0, 20.0, -54.8, -68.3, 21.5)
    ]
    assert float(read["LONG_SCALE"].split()[0]) == 4.0 and float(read["LAT_SCALE"].split()[0]) == 3.0
    for n in (1, 7, 20):
        assert float(read[f"LINE_NUM_COEFF_{n}"]) == n and float(read[f"SAMP_DEN_COEFF_{n}"]) == 0.5 * n
        assert float(read[f"LINE_DEN_COEFF_{n}"]) == n + 0.25 and float(read[f"SAMP_NUM_COEFF_{n}"]) == -n
