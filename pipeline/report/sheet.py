"""What is signed: a matrix in its forms, and what it belongs to: dates, altitude, camera, axes, data."""

from __future__ import annotations

import functools
from typing import Any

import pyarrow as pa

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.report.page_template import Number, number_from
from boresight.records.record import record, scalar

__all__ = ["SheetBasis", "angles", "basis_of", "matrix_numbers"]

AXES = {
    "axes of c": "remote-sensing camera: X along the direction of flight, Y along the detectors, Z out of "
    "it along the optical axis; a point (x, y) of the focal plane is seen in the direction (−x, −y, f)",
    "axes of s": "star camera: X towards smaller columns, Y towards smaller rows, Z out of the camera along "
    "its boresight",
}


@record(kw_only=True)
class SheetBasis:
    """What a matrix belongs to."""

    facts: dict[str, str] = scalar("texts by name: data, dates, star camera, axes")
    altitude: Number = scalar("of the satellite, km above the ellipsoid")
    quaternion: tuple[Number, ...] = scalar("R°_cs, scalar last: the matrix before launch")
    sigma_arcsec: tuple[Number, ...] = scalar("its 1-sigma about the axes of c")
    is_simulated: bool = scalar("whether the data are simulated")


def basis_of(context: dict[str, Any], source: str, inputs: pa.Table, last: str = "") -> SheetBasis:
    """The basis of a dump's matrix, by its context.json (the file `source`) and its input files. Of several
    dumps, by those of the first, to the instant `last`, UTC.
    """
    digests = dict(zip(inputs.column("file").to_pylist(), inputs.column("sha256").to_pylist()))
    first, own_last = context["utc"]
    star = context["star_camera_file"]
    by = context["created_by"] or "its origin is not stated in dump.toml"
    number = functools.partial(number_from, context, source)
    return SheetBasis(
        facts={
            "data": f"simulated, by {by}" if context["is_simulated"] else by,
            "observed": f"{_to_seconds(first)} to {_to_seconds(last or own_last)} UTC",
            "star camera": f"{star}, SHA-256 {digests.get(star, 'not known')}" if star else "attitudes alone",
        }
        | AXES,
        altitude=number("altitude_m", ".1f", scale=1e-3),
        quaternion=tuple(number(f"quaternion_cs0.{i}", "+.12f") for i in range(4)),
        sigma_arcsec=tuple(number(f"sigma_installation_rad.{i}", ".4g", scale=1 / ARCSEC) for i in range(3)),
        is_simulated=bool(context["is_simulated"]),
    )


def _to_seconds(utc: str) -> str:
    return utc[:19].replace("T", " ")


def matrix_numbers(content: dict[str, Any], source: str, of: str = "") -> dict[str, Any]:
    """The matrix at the top of a content, or under the key `of`, which ends with a dot, in all its forms."""
    number = functools.partial(number_from, content, source)

    def square(key: str, form: str) -> list[list[Number]]:
        return [[number(f"{of}{key}.{i}.{j}", form) for j in range(3)] for i in range(3)]

    return {
        "matrix": square("R_cs", "+.12f"),
        "matrix_short": square("R_cs", "+.9f"),
        "quaternion": [number(f"{of}quaternion.{i}", "+.12f") for i in range(4)],
        "covariance": square("covariance_rad2", "+.4e"),
        "theta_rad": [number(f"{of}theta_rad.{i}", "+.9f") for i in range(3)],
        "sigma_rad": [number(f"{of}covariance_rad2.{i}.{i}", ".3e", root=True) for i in range(3)],
        "euler_deg": [number(f"{of}euler_zxy_deg.{i}", "+.8f") for i in range(3)],
        **angles(content, source, f"{of}theta_rad", f"{of}covariance_rad2"),
    }


def angles(content: dict[str, Any], source: str, theta: str, covariance: str) -> dict[str, list[Number]]:
    """theta and its 1-sigma, arcsec, by the keys of theta (rad) and its covariance (rad²)."""
    arcsec = functools.partial(number_from, content, source, scale=1 / ARCSEC)
    return {
        "theta": [arcsec(f"{theta}.{i}", "+.4f") for i in range(3)],
        "sigma": [arcsec(f"{covariance}.{i}.{i}", ".4f", root=True) for i in range(3)],
    }
