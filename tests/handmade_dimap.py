"""A small DIMAP file of Pleiades, and any V1 file as V2."""

import xml.etree.ElementTree as ET

import numpy as np


def dimap_text() -> str:
    """The elements of a Pleiades DIMAP file that are read, over a circular orbit of 40 s."""
    radius, rate = 7_064_000.0, 1.06e-3
    points = []
    for n in range(9):
        angle = rate * 5.0 * n
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        vx, vy = -rate * y, rate * x
        points.append(
            f"<Point><LOCATION_VALUES>{x:.3f} 0.0 {y:.3f}</LOCATION_VALUES>"
            f"<VELOCITY_VALUES>{vx:.6f} {7.292115e-5 * x:.6f} {vy:.6f}</VELOCITY_VALUES>"
            f"<UTC_TIME>2018-12-26T10:48:{40 + 5 * n if n < 4 else 0:02d}.000000Z</UTC_TIME></Point>".replace(
                "10:48:00", f"10:49:{5 * (n - 4):02d}"
            )
        )
    quaternion = "".join(
        f"<Q{k}><DEGREE>1</DEGREE><COEFFICIENTS>{q} 1e-4</COEFFICIENTS></Q{k}>"
        for k, q in enumerate((0.7071, 0.0, -0.7071, 0.0))  # z to -x, down
    )
    look = "".join(
        f"<Psi{a}_Model><DEGREE>1</DEGREE><COEFFICIENTS>{c}</COEFFICIENTS></Psi{a}_Model>"
        for a, c in (("X", "-1e-2 1e-6"), ("Y", "1e-3 0.0"))
    )
    return (
        "<PHR_Dimap_Document><Dataset_Identification><DATASET_NAME>D</DATASET_NAME></Dataset_Identification>"
        "<Raster_Dimensions><NCOLS>20000</NCOLS><NROWS>9000</NROWS></Raster_Dimensions>"
        "<Geometric_Data><Sensor_Model_Characteristics>"
        "<UTC_Sensor_Model_Range><START>2018-12-26T10:48:55.4490000Z</START></UTC_Sensor_Model_Range>"
        "<SENSOR_LINE_PERIOD>0.0735</SENSOR_LINE_PERIOD>"
        f"<Sensor_Ephemeris><Point_List>{''.join(points)}</Point_List></Sensor_Ephemeris>"
        f"<Sensor_Attitudes><OFFSET>38935.0</OFFSET><SCALE>1.0</SCALE>"
        f"<Polynomial_Models>{quaternion}</Polynomial_Models></Sensor_Attitudes>"
        "<Sensor_Viewing_Model><Position_In_Retina><FIRST_COL>1</FIRST_COL><LAST_COL>20000</LAST_COL>"
        f"</Position_In_Retina><Viewing_Directions>{look}</Viewing_Directions></Sensor_Viewing_Model>"
        "</Sensor_Model_Characteristics></Geometric_Data></PHR_Dimap_Document>"
    )


def as_version_2(text: str, *, listed: bool = False, microseconds: bool = False, first_col: int = 1) -> str:
    """A DIMAP V1 text as the same product in V2: names and places of elements as in Pleiades and SPOT 6.

    The attitude may become a list of quaternions (Neo, SPOT), the line period microseconds; with `first_col`
    the look angles are polynomials of a column that is counted from another one.
    """
    old = ET.fromstring(text)
    model = old.find("Geometric_Data/Sensor_Model_Characteristics")
    period = float(model.findtext("SENSOR_LINE_PERIOD"))
    rows, columns = (old.findtext(f"Raster_Dimensions/{name}") for name in ("NROWS", "NCOLS"))
    start = model.findtext("UTC_Sensor_Model_Range/START").rstrip("Z")
    end = np.datetime64(start, "ns") + np.timedelta64(round(1e6 * period * (int(rows) - 1)), "ns")
    points = "".join(
        f"<Point><LOCATION_XYZ>{one.findtext('LOCATION_VALUES')}</LOCATION_XYZ><VELOCITY_XYZ>"
        f"{one.findtext('VELOCITY_VALUES')}</VELOCITY_XYZ><TIME>{one.findtext('UTC_TIME')}</TIME></Point>"
        for one in model.findall("Sensor_Ephemeris/Point_List/Point")
    )
    attitudes = model.find("Sensor_Attitudes")
    parts = {k: attitudes.find(f"Polynomial_Models/Q{k}") for k in range(4)}
    offset, scale = (attitudes.findtext(name) for name in ("OFFSET", "SCALE"))
    if listed:
        of_parts = [list(map(float, parts[k].findtext("COEFFICIENTS").split())) for k in range(4)]
        midnight, quaternions = np.datetime64(start[:10], "ns"), ""
        for second in np.arange(float(offset) - 4.0, float(offset) + 12.0, 1.0 / 32.0):
            x = (second - float(offset)) / float(scale)
            q = np.array([np.polynomial.polynomial.polyval(x, one) for one in of_parts])
            unit = (q / np.linalg.norm(q)).tolist()
            values = "".join(f"<Q{k}>{value!r}</Q{k}>" for k, value in enumerate(unit))
            time = midnight + np.timedelta64(round(1e9 * second), "ns")
            quaternions += f"<Quaternion><TIME>{time}Z</TIME>{values}</Quaternion>"
        attitude = f"<Quaternion_List>{quaternions}</Quaternion_List>"
    else:
        polynomials = "".join(ET.tostring(one, encoding="unicode") for one in parts.values())
        attitude = f"<OFFSET>{offset}</OFFSET><SCALE>{scale}</SCALE>{polynomials}"
        attitude = f"<Polynomial_Quaternions>{attitude}</Polynomial_Quaternions>"
    looks = ""
    for axis in "XY":
        psi = model.findtext(f"Sensor_Viewing_Model/Viewing_Directions/Psi{axis}_Model/COEFFICIENTS").split()
        a, b = [*map(float, psi), 0.0][:2]
        looks += f"<{axis}LOS_0>{a - b * (first_col - 1)!r}</{axis}LOS_0><{axis}LOS_1>{b!r}</{axis}LOS_1>"
    looks = f"<Polynomial_Look_Angles>{looks}</Polynomial_Look_Angles>"
    if listed:
        looks = f"<Band_Calibration_List><Band_Calibration>{looks}</Band_Calibration></Band_Calibration_List>"
    name = old.findtext("Dataset_Identification/DATASET_NAME")
    return (
        f"<Dimap_Document><Dataset_Identification><DATASET_NAME>{name}</DATASET_NAME></Dataset_Identification>"
        f"<Raster_Data><Raster_Dimensions><NROWS>{rows}</NROWS><NCOLS>{columns}</NCOLS></Raster_Dimensions>"
        f"</Raster_Data><Geometric_Data><Refined_Model><Time><Time_Range><START>{start}Z</START>"
        f"<END>{end}Z</END></Time_Range><Time_Stamp><LINE_PERIOD>{period * (1e3 if microseconds else 1.0)!r}"
        f"</LINE_PERIOD></Time_Stamp></Time><Ephemeris><Point_List>{points}</Point_List></Ephemeris>"
        f"<Attitudes>{attitude}</Attitudes><Geometric_Calibration><Instrument_Calibration><Swath_Range>"
        f"<FIRST_COL>{first_col}</FIRST_COL></Swath_Range>{looks}</Instrument_Calibration>"
        "</Geometric_Calibration></Refined_Model></Geometric_Data></Dimap_Document>"
    )
