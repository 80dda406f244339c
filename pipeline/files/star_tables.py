"""Stars for strips of the sky: the bundled Hipparcos, or a table of the user's (CSV, FITS, VOTable).

Columns are named as those of the Gaia archive; `source_id` may be any whole number. Angles are ICRS.
"""

from __future__ import annotations

import io
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from boresight.geometry.constants import ARCSEC
from boresight.geometry.starlight import StarPlaces, SurveyedStars
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.content import Identity, check_extent, identity_of, limited_content
from boresight.pipeline.files.xml_files import read_xml
from boresight.records.record import Floats, record
from boresight.star_id.whole_catalogue import all_hipparcos

__all__ = ["StarTable", "read_star_table", "survey_of"]

# Astropy's name of a table's format by the file's suffix.
FORMATS = {".csv": "ascii.csv", ".fits": "fits", ".fit": "fits", ".vot": "votable", ".xml": "votable"}
FITS_MAGIC = b"SIMPLE  ="  # first bytes of every FITS file
MAX_BYTES = 2**27  # of a file, and of a text table whose rows are all as long as its longest
MAX_CELLS = 2**25
MAS = 1e-3 * ARCSEC
# Name, least and largest value, value where the column is absent (None: it must be there)
COLUMNS: dict[str, tuple[float, float, float | None]] = {
    "ra": (0.0, 360.0, None),
    "dec": (-90.0, 90.0, None),
    "ref_epoch": (1900.0, 2100.0, None),
    "pmra": (-2e4, 2e4, None),
    "pmdec": (-2e4, 2e4, None),
    "phot_g_mean_mag": (-3.0, 30.0, None),
    "ra_error": (0.0, 1e4, None),
    "dec_error": (0.0, 1e4, None),
    "pmra_error": (0.0, 1e3, None),
    "pmdec_error": (0.0, 1e3, None),
    "parallax": (-1e3, 1e3, 0.0),
    "radial_velocity": (-2e3, 2e3, 0.0),
    "bp_rp": (-5.0, 20.0, np.nan),
}


@record(by_value=True)
class StarTable:
    """A user's table of stars: read once in each process while it stays the same (`survey_of`)."""

    file: str
    path: Path


def survey_of(table: StarTable | None) -> SurveyedStars:
    """The stars of a table; None: all of Hipparcos."""
    return all_hipparcos() if table is None else _read(table, identity_of(table.path))


@lru_cache(maxsize=1)
def _read(table: StarTable, identity: Identity) -> SurveyedStars:
    return read_star_table(table.path, table.file)


def read_star_table(path: Path, file: str) -> SurveyedStars:
    """Stars of a CSV, FITS or VOTable file; rows without proper motion or errors are left out.

    `RawDataError` for another format, a missing column, or a value out of its range.
    """
    if (kind := FORMATS.get(path.suffix.lower())) is None:
        raise RawDataError(file, "file", path.suffix or "no suffix", f"one of {', '.join(FORMATS)}")
    content = limited_content(path, file, "a readable file", MAX_BYTES)
    from astropy.table import Table  # with pandas 0.6 s to load

    if kind == "votable":
        _check_streams(read_xml(path, file), file)  # and no DTD or entity, before another parser sees it
    elif kind == "fits" and not content.startswith(FITS_MAGIC):
        raise RawDataError(file, "byte 0", content[:8].hex(" "), "a FITS file that is not packed")
    elif kind == "ascii.csv":
        lines = content.split(b"\n")
        check_extent(file, "table", (len(lines), max(map(len, lines))), MAX_BYTES, "bytes")
        check_extent(file, "table", (content.count(b",") + len(lines),), MAX_CELLS, "cells")
    try:
        if kind == "fits":
            _check_cells(content, file)
        table = Table.read(io.BytesIO(content), format=kind)
    except RawDataError:
        raise
    except Exception as error:  # astropy raises errors of many kinds for a damaged file
        raise RawDataError(file, "table", f"{type(error).__name__}: {error}", f"a table ({kind})") from error
    table.rename_columns(table.colnames, [name.lower() for name in table.colnames])
    if "source_id" not in table.colnames:
        raise RawDataError(file, "source_id", "no such column", "a column of whole numbers")
    c = {name: _column(table, name, file) for name in COLUMNS}
    number = np.ma.asarray(table["source_id"])
    if number.dtype.kind not in "iu":
        raise RawDataError(file, "source_id", str(number.dtype), "whole numbers")
    needed = [name for name, (_, _, absent) in COLUMNS.items() if absent is None]
    whole = np.all([np.isfinite(c[name]) for name in needed], axis=0) & ~np.ma.getmaskarray(number)
    if not whole.any():
        raise RawDataError(file, "rows", "none that is complete", "at least one star")
    c, epoch = {name: values[whole] for name, values in c.items()}, c["ref_epoch"][whole]
    if np.ptp(epoch) > 0.0:
        raise RawDataError(file, "ref_epoch", f"{epoch.min()} to {epoch.max()}", "one epoch for all stars")
    dec = np.radians(c["dec"])
    places = StarPlaces(
        hip=np.asarray(number[whole], dtype=np.int64),
        ra_rad=np.radians(c["ra"]),
        dec_rad=dec,
        pm_ra_rad_yr=c["pmra"] * MAS / np.cos(dec),
        pm_dec_rad_yr=c["pmdec"] * MAS,
        parallax_arcsec=np.nan_to_num(c["parallax"]) * 1e-3,
        radial_velocity_km_s=np.nan_to_num(c["radial_velocity"]),
        v_mag=c["phot_g_mean_mag"],
        b_v=c["bp_rp"],
        epoch_jyear=float(epoch[0]),
    )
    return SurveyedStars(
        name="star",
        places=places,
        sigma_rad=np.hypot(c["ra_error"], c["dec_error"]) / np.sqrt(2.0) * MAS,
        sigma_pm_rad_yr=np.hypot(c["pmra_error"], c["pmdec_error"]) / np.sqrt(2.0) * MAS,
        single=np.ones(len(dec), dtype=bool),
    )


def _check_cells(content: bytes, file: str) -> None:
    """`RawDataError` for a FITS file with a table of too many cells."""
    from astropy.io import fits

    with fits.open(io.BytesIO(content)) as hdus:
        for header in (hdu.header for hdu in hdus if "TFIELDS" in hdu.header):
            check_extent(file, "table", (int(header["NAXIS2"]), int(header["TFIELDS"])), MAX_CELLS, "cells")


def _check_streams(root: Element, file: str) -> None:
    """`RawDataError` where a VOTable's rows lie elsewhere or are packed: astropy fetches and unpacks them."""
    for stream in root.iter("STREAM"):
        here = {key: value for key, value in stream.attrib.items() if key != "type"}
        if here not in ({}, {"encoding": "base64"}):
            found = ", ".join(f'{key}="{value}"' for key, value in here.items())
            raise RawDataError(file, "STREAM", found, 'the table itself, in encoding="base64"')


def _column(table: Any, name: str, file: str) -> Floats:
    """A column as numbers, NaN where it is empty; `RawDataError` if it is missing or out of range."""
    low, high, absent = COLUMNS[name]
    if name not in table.colnames:
        if absent is None:
            raise RawDataError(file, name, "no such column", "this column, named as in the Gaia archive")
        return np.full(len(table), absent)
    with refusing(file, name, "numbers", (TypeError, ValueError)):
        values = np.ma.filled(np.ma.asarray(table[name]).astype(float), np.nan)
    wrong = np.flatnonzero((values < low) | (values > high))
    if len(wrong):
        cell = f"row {wrong[0] + 1}, {name}"
        raise RawDataError(file, cell, float(values[wrong[0]]), f"{low:g} to {high:g}")
    return values
