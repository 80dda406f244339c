"""A small DIMAP file of Pleiades."""

from __future__ import annotations

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
