"""What a calibration from vectors found, as tables, as a result folder and as a page."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from scipy.special import chdtrc

from boresight.calib.estimate import NotObservable
from boresight.features.vectors.vector_estimate import INDEPENDENT, VectorCalibration
from boresight.geometry.constants import ARCSEC
from boresight.geometry.sightings import ExposureAttitudes, VectorSets
from boresight.pipeline.files.record_tables import columns_of
from boresight.pipeline.files.table_files import arrow_array
from boresight.pipeline.files.whole_file import json_text
from boresight.pipeline.results.sightings_tables import COLUMNS, pairs_table, sightings_schema
from boresight.pipeline.results.writing import installation_facts, write_tables
from boresight.pipeline.run.settings import Settings
from boresight.records.ledger import Entry, Kind, Reason, Subject
from boresight.records.record import Floats, Ints

__all__ = ["vector_facts", "vector_tables", "why_not", "write_vector_result"]


def vector_facts(vectors: VectorSets, found: VectorCalibration) -> dict[str, Any]:
    """What installation.json holds, as it is read back."""
    estimate, none = found.estimate, np.full(3, np.nan)
    stars = {strip.exposures[0].t_s: len(strip.exposures[0].hip) for strip in found.strips}  # by instant
    counts = (
        f"{estimate.n_exposures} of {len(stars)} frames with {estimate.n_stars} of {sum(stars.values())} "
        f"star vectors and {estimate.n_targets} of {len(vectors.w_c)} target vectors"
    )
    facts = installation_facts(estimate, found.verdict, (), (INDEPENDENT, Settings()), [none])
    return dict(json.loads(json_text(facts | {"made_from": "vectors", "counts": counts})))


def vector_tables(vectors: VectorSets, found: VectorCalibration) -> dict[str, pd.DataFrame]:
    """Targets and stars, one row each, and what is not used, by frame and number in it."""
    unused = [_of_frame(entry, vectors).row for entry in found.estimate.rejected]
    empty = np.flatnonzero(np.diff(vectors.target_start) == 0)
    lost = [Entry(Subject(Kind.EXPOSURE, exposure=str(k)), Reason.NO_TARGET, "has no targets") for k in empty]
    return {
        "targets": _target_table(vectors, found),
        "stars": _star_table(vectors, found),
        "ledger": pd.DataFrame([*unused, *(one.row for one in lost)], columns=list(COLUMNS["ledger"])),
    }


def write_vector_result(folder: Path, found: VectorCalibration, facts: dict[str, Any], tables: Any) -> None:
    """Write the result folder, which `read_result`, `compare` and exports without images take."""
    own = {strip.exposures[0].exposure_id: strip for strip in found.strips}
    attitudes = ExposureAttitudes.together([one.attitudes for one in own.values() if one.attitudes])
    exposures = {
        "exposure_id": arrow_array(list(own), pa.string()),
        "t_s": arrow_array([one.exposures[0].t_s for one in own.values()], pa.float64()),
        "stars": arrow_array([len(one.exposures[0].hip) for one in own.values()], pa.int64()),
    }
    written = {name: pa.Table.from_pandas(table, preserve_index=False) for name, table in tables.items()}
    written |= {
        "exposures": pa.table(exposures | columns_of(attitudes, "K")),
        "passes": sightings_schema("passes").empty_table(),  # no frame has an orbit
        "strips": pairs_table(found.estimate.pairs),
    }
    write_tables(folder, written, facts)


def why_not(found: NotObservable, vectors: VectorSets) -> str:
    """What the vectors lack: frames whose stars do not agree, or targets that are left, and their errors."""
    lost = [entry for entry in found.rejected if entry.subject.kind is Kind.EXPOSURE]
    if lost:
        first = _of_frame(lost[0], vectors)
        n_good, n_all = first.more
        return (
            f"{len(lost)} frames have no attitude: of the {n_all:.0f} stars of frame {first.subject.name} "
            f"{n_good:.0f} agree within sigma_s, 3 are needed; check the pairs of u_s and v_stars, "
            "and sigma_s"
        )
    J, n = len(vectors.w_c), sum(entry.reason is Reason.TARGET_RESIDUAL for entry in found.rejected)
    what, _, remedy = found.reason.replace("strips", "frames").partition("; ")
    if 2 * n > J:
        remedy = "check the pairs of w_c and v_targets, their signs and order, and sigma_c"
    if (sigma := float(np.median(vectors.sigma_c))) > INDEPENDENT.sigma_observable_rad:
        remedy = "sigma_c is larger than that; is it in rad?"
    return f"{what}; {J - n} of {J} targets agree, of sigma_c {sigma:.2g} rad; {remedy}"


def _in_frame(row: Ints, start: Ints) -> tuple[Ints, Ints]:
    """Frame (M,), and number in it, of rows (M,) of all vectors."""
    frame = np.searchsorted(start, row, side="right") - 1
    return frame, row - start[frame]


def _of_frame(entry: Entry, vectors: VectorSets) -> Entry:
    """The entry with its vectors by frame and number: stars as stars, targets as targets."""

    def named(subject: Subject) -> Subject:
        if subject.kind is Kind.EXPOSURE:
            return replace(subject, exposure=str(int(subject.exposure)))
        if subject.kind is Kind.STRIP:
            return Subject(Kind.EXPOSURE, exposure=str(int(subject.strip)))
        if subject.exposure:
            frame, number = _in_frame(np.array(int(subject.id)), vectors.star_start)
            return Subject(Kind.STAR, exposure=str(frame), id=str(number))
        k = int(subject.strip)
        if vectors.target_id is None:
            n = int(subject.id) - int(vectors.target_start[k])
        else:
            n = vectors.target_id[slice(*vectors.target_start[k : k + 2])].tolist().index(subject.id)
        return Subject(Kind.TARGET, strip=str(k), id=str(n))

    return replace(entry, subject=named(entry.subject), rivals=tuple(map(named, entry.rivals)))


def _target_table(vectors: VectorSets, found: VectorCalibration) -> pd.DataFrame:
    residuals = found.estimate.targets
    frame, number = _in_frame(np.arange(len(vectors.w_c)), vectors.target_start)
    columns = {
        "residual_x_arcsec": residuals.residual_c[:, 0] / ARCSEC,
        "residual_y_arcsec": residuals.residual_c[:, 1] / ARCSEC,
    }
    fitted = _fitted(columns, residuals.statistic, residuals.kept)
    more = {"weight": residuals.weight, "detectable_arcsec": residuals.detectable_rad / ARCSEC}
    places = vectors.target_id.tolist() if vectors.target_id is not None else ()
    of_place = zip(("lat_deg", "lon_deg", "height_m"), zip(*(map(float, one.split("/")) for one in places)))
    return pd.DataFrame({"frame": frame, "target": number} | fitted | more | dict(of_place))


def _star_table(vectors: VectorSets, found: VectorCalibration) -> pd.DataFrame:
    parts = []
    for strip in {one.exposures[0].exposure_id: one for one in found.strips}.values():
        attitudes, stars = strip.fitted, strip.exposures[0]
        residual = (stars.u_s - stars.u_i @ attitudes.R_si[0].T) / ARCSEC
        frame, number = _in_frame(stars.hip, vectors.star_start)
        columns = {"residual_x_arcsec": residual[:, 0], "residual_y_arcsec": residual[:, 1]}
        kept = attitudes.kept & attitudes.usable[0]
        fitted = _fitted(columns, attitudes.squared_mahalanobis, kept)
        parts.append(pd.DataFrame({"frame": frame, "star": number} | fitted))
    return pd.concat(parts, ignore_index=True)


def _fitted(columns: dict[str, Floats], statistic: Floats, kept: Any) -> dict[str, Any]:
    return columns | {"statistic": statistic, "p_value": chdtrc(2, statistic), "kept": kept}
