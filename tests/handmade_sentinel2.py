"""A small Sentinel-2 datastrip with its GIPP files: two detectors of 24 pixels over a circular orbit."""
# ruff: noqa: E501

from pathlib import Path

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

DATASTRIP = "S2A_OPER_MTD_L1B_DS_TEST.xml"
SPAMOD = "S2A_OPER_GIP_SPAMOD_TEST_B00"
VIEDIR = "S2A_OPER_GIP_VIEDIR_TEST_B04"
POINT = (  # a row of points.csv, in the picture of the second detector
    "id,strip,ccd,sample,line,sigma_sample_px,sigma_line_px,lat_deg,lon_deg,height_m,height_kind,"
    "sigma_east_m,sigma_north_m,sigma_up_m\na,B04,1,3,100,1,1,10,20,50,ellipsoidal,1,1,1\n"
)
_REFINING = """<Refined_Corrections_List><Refined_Corrections><MSI_State>
<Rotation><X><DEGREE>1</DEGREE><COEFFICIENTS>2e-6 -4e-8</COEFFICIENTS></X>
<Y><DEGREE>0</DEGREE><COEFFICIENTS>3e-6</COEFFICIENTS></Y><Z><DEGREE>0</DEGREE><COEFFICIENTS>1e-6</COEFFICIENTS></Z>
</Rotation><Homothety><Z><DEGREE>0</DEGREE><COEFFICIENTS>-2.5e-6</COEFFICIENTS></Z></Homothety>
</MSI_State></Refined_Corrections></Refined_Corrections_List>"""


def write_sentinel2(folder: Path) -> Path:
    """Write datastrip and GIPP files; the path of the datastrip."""
    (folder / f"{SPAMOD}.xml").write_text(_spamod())
    (folder / f"{VIEDIR}.xml").write_text(_viedir())
    (folder / DATASTRIP).write_text(_datastrip())
    return folder / DATASTRIP


def _spamod() -> str:
    trackers = "".join(
        f"<STR{n}_ATT_QUATERNION><VECTOR>{x} {y} {z}</VECTOR><SCALAR>{w}</SCALAR></STR{n}_ATT_QUATERNION>"
        for n, (x, y, z, w) in enumerate([(0.6, 0.0, 0.0, 0.8), (0.0, -0.8, 0.0, 0.6)], start=1)
    )
    angles = "".join(
        f'<R{k} axis="{axis}" unit="mrad">{value}</R{k}>'
        for k, axis, value in ((1, "X", -0.03), (2, "Y", -0.96), (3, "Z", 0.02))
    )
    mounting = f"<PILOTING_TO_MSI_FRAME>{angles}<SCALE_FACTOR>1</SCALE_FACTOR></PILOTING_TO_MSI_FRAME>"
    return f"<GS2_SPACECRAFT_MODEL_PARAMETERS><DATA><GSE>{trackers}</GSE>{mounting}</DATA></GS2_SPACECRAFT_MODEL_PARAMETERS>"


def _viedir() -> str:
    tables = ""
    for n in range(2):
        psi_x = 0.001 * (n - 1) + 1.27e-5 * np.arange(24)
        psi_y = (0.01 if n == 0 else -0.01) + 1e-8 * np.arange(24)
        lists = "".join(
            f"<TAN_PSI_{a}_LIST>{' '.join(f'{v:.12f}' for v in values)}</TAN_PSI_{a}_LIST>"
            for a, values in (("X", psi_x), ("Y", psi_y))
        )
        tables += f'<VIEWING_DIRECTIONS detector_id="{n + 1:02d}"><NB_OF_PIXELS>24</NB_OF_PIXELS>{lists}</VIEWING_DIRECTIONS>'
    body = f'<BAND_ID>3</BAND_ID><VIEWING_DIRECTIONS_LIST tdi_config="APPLIED">{tables}</VIEWING_DIRECTIONS_LIST>'
    return f"<GS2_VIEWING_DIRECTIONS><DATA>{body}</DATA></GS2_VIEWING_DIRECTIONS>"


def _gps(t_s: float) -> str:
    """GPS date of seconds after 2020-08-16T12:02:18 GPS time, which is 12:02:00 UTC."""
    whole = np.datetime64("2020-08-16T12:02:18", "us") + np.timedelta64(round(t_s * 1e6), "us")
    return str(whole)


def _datastrip() -> str:
    t = np.arange(-10.0, 31.0)
    rate, radius = 2.0 * np.pi / 6040.0, 7.167e6
    p = radius * np.column_stack([np.cos(rate * t), np.zeros_like(t), np.sin(rate * t)])
    v = radius * rate * np.column_stack([-np.sin(rate * t), np.zeros_like(t), np.cos(rate * t)])
    points = "".join(
        f"<GPS_Point><POSITION_VALUES>{_row(1e3 * a)}</POSITION_VALUES><POSITION_ERRORS>2000 1000 3000</POSITION_ERRORS>"
        f"<VELOCITY_VALUES>{_row(1e3 * b)}</VELOCITY_VALUES><GPS_TIME>{_gps(at)}</GPS_TIME></GPS_Point>"
        for at, a, b in zip(t, p, v)
    )
    t = np.arange(-5.0, 25.0, 0.1)
    # Earth's rotation angle alone takes ITRS to inertial axes here, within 0.3 degrees of precession.
    era = erfa.era00(2459078.0, (12.0 * 3600.0 + 120.0 + t) / 86400.0 - 0.5)
    p, v = np.cos(rate * t), np.sin(rate * t)
    zero = np.zeros_like(t)
    x, z = np.stack([-v, zero, p], axis=1), -np.stack([p, zero, v], axis=1)
    axes = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=2))
    nadir = Rotation.from_rotvec(np.column_stack([zero, zero, era])) * axes
    corrected = "".join(
        f"<Values><QUATERNION_VALUES>{_row(q)}</QUATERNION_VALUES><QUATERNION_VALIDITY>true</QUATERNION_VALIDITY>"
        f"<GPS_TIME>{_gps(at)}</GPS_TIME></Values>"
        for at, q in zip(t, nadir.as_quat())
    )
    mounting = {"STR1": Rotation.from_quat([0.6, 0, 0, 0.8]), "STR2": Rotation.from_quat([0, -0.8, 0, 0.6])}
    trackers = "".join(
        f'<STR strId="{name}"><Attitude_Data_List>{_raw(t, nadir * R_ps)}</Attitude_Data_List></STR>'
        for name, R_ps in mounting.items()
    )
    stamps = "".join(
        f'<Detector detectorId="{n + 1:02d}"><REFERENCE_LINE>1</REFERENCE_LINE><GPS_TIME>{_gps(at)}</GPS_TIME></Detector>'
        for n, at in enumerate([2.5, 6.5])
    )
    granules = "".join(f"<Granule><POSITION>{at}</POSITION></Granule>" for at in (1, 2305))
    return f"""<n1:Level-1B_DataStrip_ID xmlns:n1="urn:s2" datastripIdentifier="S2A_TEST">
<n1:General_Info><Datatake_Info><SPACECRAFT_NAME>Sentinel-2A</SPACECRAFT_NAME></Datatake_Info><Datastrip_Time_Info>
<DATASTRIP_SENSING_START>2020-08-16T12:02:02.500Z</DATASTRIP_SENSING_START>
<DATASTRIP_SENSING_STOP>2020-08-16T12:02:12.500Z</DATASTRIP_SENSING_STOP></Datastrip_Time_Info></n1:General_Info>
<n1:Image_Data_Info><Granules_Information><Detector_List><Detector><Granule_List>{granules}</Granule_List></Detector>
</Detector_List></Granules_Information><Sensor_Configuration><Acquisition_Configuration><TDI_Configuration_List>
<TDI_CONFIGURATION bandId="3">APPLIED</TDI_CONFIGURATION></TDI_Configuration_List></Acquisition_Configuration>
<Time_Stamp><LINE_PERIOD>1.5658</LINE_PERIOD><Band_Time_Stamp bandId="3">{stamps}</Band_Time_Stamp></Time_Stamp>
</Sensor_Configuration><Radiometric_Info><Spectral_Information_List><Spectral_Information bandId="3" physicalBand="B4">
<RESOLUTION>10</RESOLUTION></Spectral_Information></Spectral_Information_List></Radiometric_Info>
<Geometric_Info>{_REFINING}</Geometric_Info></n1:Image_Data_Info>
<n1:Satellite_Ancillary_Data_Info><Ephemeris><GPS_Points_List>{points}</GPS_Points_List></Ephemeris>
<Attitudes><Corrected_Attitudes>{corrected}</Corrected_Attitudes><Raw_Attitudes><STR_List>{trackers}</STR_List>
</Raw_Attitudes></Attitudes></n1:Satellite_Ancillary_Data_Info>
<n1:Auxiliary_Data_Info><IERS_Bulletin><UT1_UTC>-0.27381</UT1_UTC><POLE_U_ANGLE>0.2393</POLE_U_ANGLE>
<POLE_V_ANGLE>0.362</POLE_V_ANGLE></IERS_Bulletin><GIPP_List><GIPP_FILENAME>{SPAMOD}</GIPP_FILENAME>
<GIPP_FILENAME>{VIEDIR}</GIPP_FILENAME></GIPP_List></n1:Auxiliary_Data_Info></n1:Level-1B_DataStrip_ID>
"""


def _raw(t: np.ndarray, R_is: Rotation) -> str:
    return "".join(
        f"<Attitude_Data><QUATERNION_VALUES>{_row(q)}</QUATERNION_VALUES><GPS_TIME>{_gps(at)}</GPS_TIME>"
        f"<ATTITUDE_QUALITY>VALIDATT</ATTITUDE_QUALITY></Attitude_Data>"
        for at, q in zip(t, R_is.as_quat())
    )


def _row(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)
