"""A GIPP file of Sentinel-2 with a result's matrix: the operator's own text, in which nothing else changes.

With the calibrated rotation D = R_cs R_cs0^-1 of the camera's axes either file takes the whole correction:

    SPAMOD   the angles of PILOTING_TO_MSI_FRAME, intrinsic about y, x, z, mrad:  P becomes D P
    VIEDIR   the look directions of a band, u_c ~ [tan_psi_y, -tan_psi_x, 1]:     u_c becomes D^-1 u_c

A processor is to take one of the two. Dates of applicability change where they are given. Neither file has a
place for a covariance, which is in the format `calibration`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.text_files import read_text

__all__ = ["corrected_gipp"]

FRAME = re.compile(r"<PILOTING_TO_MSI_FRAME>.*?</PILOTING_TO_MSI_FRAME>", re.DOTALL)
LOOKS = re.compile(r"<VIEWING_DIRECTIONS .*?</VIEWING_DIRECTIONS>", re.DOTALL)
ANGLES = ("R1", "R2", "R3")  # about x, y, z
SAME_RAD = 1e-6  # between the matrix of the file and that of the dump: ten digits of a quaternion


def corrected_gipp(
    product: Path, correction: Rotation, R_cs0: Rotation, head: str, dates: tuple[str, str] = ("", "")
) -> str:
    """The text of a SPAMOD or VIEDIR file, XML, corrected by a rotation of frame c.

    `R_cs0` is the matrix of the dump before the calibration and `head` its star camera: a SPAMOD file must
    have the same. `dates`: of applicability, ISO 8601 UTC; empty: as they are. `RawDataError` for another
    file.
    """
    text = read_text(product, product.name)
    if (frame := FRAME.search(text)) is not None:
        x, y, z = 1e-3 * np.array([_number(frame[0], name, product.name) for name in ANGLES])
        R_cp = Rotation.from_euler("YXZ", [y, x, z])
        _check_is_of(text, R_cp, R_cs0, head, product.name)
        y, x, z = (correction * R_cp).as_euler("YXZ")
        block = frame[0]
        for name, angle in zip(ANGLES, (x, y, z)):
            block = _replaced(block, name, repr(float(1e3 * angle)))
        text = text.replace(frame[0], block)
    elif LOOKS.search(text) is not None:
        text = LOOKS.sub(lambda found: _turned(found[0], correction, product.name), text)
    else:
        expected = "a SPAMOD or VIEDIR file as XML text"
        raise RawDataError(
            product.name, "content", "no PILOTING_TO_MSI_FRAME, no VIEWING_DIRECTIONS", expected
        )
    for name, date in zip(("APPLICABILITY_DATE", "APPLICABILITY_END_DATE"), dates):
        text = _replaced(text, name, date) if date else text
    return text


def _check_is_of(text: str, R_cp: Rotation, R_cs0: Rotation, head: str, file: str) -> None:
    """`RawDataError` where the matrix of the file, with that of the star tracker, is not the dump's."""
    tracker = re.search(rf"<{re.escape(head)}_ATT_QUATERNION>(.*?)</{re.escape(head)}_ATT", text, re.DOTALL)
    R_ps = Rotation.identity()
    if tracker is not None:
        parts = [re.search(rf"<{name}>(.*?)</{name}>", tracker[1]) for name in ("VECTOR", "SCALAR")]
        numbers = [float(word) for part in parts if part is not None for word in part[1].split()]
        if len(numbers) != 4:
            raise RawDataError(file, f"{head}_ATT_QUATERNION", f"{len(numbers)} numbers", "4")
        R_ps = Rotation.from_quat(numbers)
    apart = (R_cs0 * (R_cp * R_ps).inv()).magnitude()
    if apart > SAME_RAD:
        expected = "the file that the dump was imported with"
        raise RawDataError(file, "PILOTING_TO_MSI_FRAME", f"{apart:.3g} rad from the dump's matrix", expected)


def _turned(block: str, correction: Rotation, file: str) -> str:
    """The look directions of one detector."""
    tan_x, tan_y = (
        np.array(_text(block, f"TAN_PSI_{axis}_LIST", file).split(), dtype=float) for axis in "XY"
    )
    u = correction.inv().apply(np.column_stack([tan_y, -tan_x, np.ones(len(tan_x))]))
    for axis, values in (("X", -u[:, 1] / u[:, 2]), ("Y", u[:, 0] / u[:, 2])):
        block = _replaced(block, f"TAN_PSI_{axis}_LIST", " ".join(f"{value:.15g}" for value in values))
    return block


def _text(block: str, name: str, file: str) -> str:
    if (found := re.search(rf"<{name}(?: [^>]*)?>([^<]*)<", block)) is None:
        raise RawDataError(file, name, "missing", "an element with numbers")
    return found[1]


def _number(block: str, name: str, file: str) -> float:
    text = _text(block, name, file)
    with refusing(file, name, "a number", found=text[:64]):
        return float(text)


def _replaced(block: str, name: str, value: str) -> str:
    """`block` with the text of its first element of that name replaced."""
    return re.sub(rf"(<{name}(?: [^>]*)?>)[^<]*(<)", rf"\g<1>{value}\g<2>", block, count=1)
