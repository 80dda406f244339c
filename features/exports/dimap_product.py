"""A DIMAP product with its attitude corrected: the operator's own file, in which nothing else changes.

The quaternion q(t) of the product takes the camera's axes to ITRS axes. With the calibrated rotation
D = R_cs R_cs0^-1 of the camera's axes the corrected one is q(t) (x) d*, d being the quaternion of D: a linear
map of the four components, which polynomials and lists of quaternions obey alike and without loss. Only the
quaternions of the model are corrected, not those of the satellite in inertial axes. Rates and scale are in
`operator_parameters`; they do not fit into the elements of every product.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Comment, Element, tostring

import defusedxml.ElementTree
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.dimap_metadata import model_attitudes
from boresight.pipeline.files.text_files import read_text
from boresight.records.record import Floats

__all__ = ["corrected_dimap"]

_OF_POLYNOMIAL = ("COEFFICIENTS", "DEGREE")  # children of Q0 ... Q3


def corrected_dimap(product: Path, correction: Rotation, notes: Mapping[str, str]) -> bytes:
    """The file with its attitude corrected by `correction`, a rotation of frame c; `notes` become a comment.

    The product is one that `read_dimap` reads; `RawDataError` where it has no quaternions.
    """
    root: Element = defusedxml.ElementTree.fromstring(read_text(product, product.name), forbid_dtd=True)
    by_components = _by_conjugate(correction)
    polynomials, listed, written = model_attitudes(root)
    if not polynomials and not listed:
        raise RawDataError(product.name, "attitudes", "none", "polynomials or a list of quaternions")
    for group in polynomials:
        parts, degrees = ([group.find(f"{{*}}Q{k}/{{*}}{name}") for k in range(4)] for name in _OF_POLYNOMIAL)
        rows = [_numbers(part, product.name) for part in parts]
        coefficients = np.zeros((4, max(map(len, rows))))
        for row, values in zip(coefficients, rows):
            row[: len(values)] = values
        for part, degree, row in zip(parts, degrees, by_components @ coefficients):
            _set(part, " ".join(map(repr, row.tolist())))
            _set(degree, str(len(row) - 1))
    for one in listed:
        parts = [one.find(f"{{*}}Q{k}") for k in range(4)]
        numbers = np.concatenate([_numbers(part, product.name) for part in parts])
        for part, value in zip(parts, by_components @ numbers):
            _set(part, repr(float(value)))
    for element in written:
        if len(numbers := _numbers(element, product.name)) == 4:
            _set(element, " ".join(map(repr, (by_components @ numbers).tolist())))
    text = "\n".join(f"{name}: {value}" for name, value in notes.items()).replace("--", "- -")
    root.insert(0, Comment(f" attitude corrected\n{text}\n"))
    return tostring(root, encoding="UTF-8", xml_declaration=True)


def _by_conjugate(rotation: Rotation) -> NDArray[np.float64]:
    """Matrix (4, 4) that multiplies a quaternion, scalar first, by the conjugate of that of `rotation`."""
    x, y, z, w = rotation.inv().as_quat()
    return np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])


def _numbers(element: Element | None, file: str) -> Floats:
    words = [] if element is None else (element.text or "").split()
    with refusing(file, "attitudes", "numbers", found=" ".join(words)[:64]):
        return np.array(words, dtype=float)


def _set(element: Element | None, text: str) -> None:
    assert element is not None
    element.text = text
