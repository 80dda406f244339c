"""The page: figures, tables and pictures put into one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import html
import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.table_files import column, list_values
from boresight.pipeline.files.whole_file import write_whole
from boresight.pipeline.report import figures
from boresight.pipeline.report.saved import Number, Saved, read_saved
from boresight.pipeline.report.star_preview import STATES

__all__ = ["data_uri", "report_html", "template", "write_report"]

MOST_MATCHES = 400  # pictures of more would make the page heavier than a browser likes
MOST_ROWS = 300  # of a long table
TO_ARCSEC = 1.0 / ARCSEC


@dataclass(frozen=True, slots=True)
class MatchCard:
    """One placed target as the page shows it."""

    name: str
    kept: bool
    template: str  # data URI
    found: str
    surface: str
    correlation: Number
    wrong: Number
    normalised: Number
    low: Number
    high: Number


@dataclass(frozen=True, slots=True)
class Detection:
    """One mark on the star image."""

    x: float
    y: float
    r: float  # size, about 1
    state: str
    words: str
    name: str  # of the star; empty where it was not named


def write_report(result: Path, *, most_matches: int = MOST_MATCHES) -> Path:
    """Draw `report.html` into a result's folder. `RawDataError` when something of the result is missing."""
    text = report_html(read_saved(result), most_matches=most_matches)
    path = result / "report.html"
    write_whole(path, lambda target: target.write_text(text, encoding="utf-8"))
    return path


def report_html(saved: Saved, *, most_matches: int = MOST_MATCHES) -> str:
    """The whole page."""
    cards, matches_in_all = _matches(saved, most_matches)
    return template("page.html.j2").render(
        saved=saved,
        summary=_summary(saved),
        iterations=_iterations(saved),
        convergence=figures.convergence(saved),
        angles=[figures.angle_histogram(saved), figures.angle_spread(saved)],
        star_map=figures.star_residual_map(saved),
        target_map=figures.target_residual_map(saved),
        ellipses=figures.covariance_ellipses(saved),
        statistics=[
            figures.normalised_histogram(saved, "stars", "stars"),
            figures.normalised_histogram(saved, "targets", "targets"),
            figures.exposure_chi2(saved),
        ],
        image=_star_image(saved),
        states=STATES,
        matches=cards,
        matches_in_all=matches_in_all,
        omissions=_omissions(saved),
        omissions_in_all=len(saved.omissions),
        kinds=sorted(Counter(saved.omissions.column("kind").to_pylist()).items()),
        settings=list(_flat(saved.installation["settings"])),
        facts=list(_flat({k: v for k, v in saved.run.items() if v is not None})),
        inputs=saved.inputs.slice(0, MOST_ROWS).to_pylist(),
        inputs_in_all=len(saved.inputs),
        most_rows=MOST_ROWS,
    )


def template(name: str) -> jinja2.Template:
    """A page's template, with the filter `number` that shows where a number comes from."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("boresight.pipeline.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = _number
    return environment.get_template(name)


def _number(value: Number) -> Markup:
    """A number with what it was made from, so that it can be checked."""
    parts = {"value": repr(value.exact), "data-source": value.source, "data-key": value.key}
    parts["data-form"] = value.form
    if value.scale != 1.0:
        parts["data-scale"] = repr(value.scale)
    if value.root:
        parts["data-root"] = "1"
    attributes = " ".join(f'{name}="{html.escape(text)}"' for name, text in parts.items())
    return Markup(f"<data {attributes}>{html.escape(value.text)}</data>")


def _summary(saved: Saved) -> dict[str, Any]:
    number, context = saved.number, saved.context_number
    return {
        "matrix": [[number(f"R_cs.{i}.{j}", "+.12f") for j in range(3)] for i in range(3)],
        "quaternion": [number(f"quaternion.{i}", "+.12f") for i in range(4)],
        "theta_rad": [number(f"theta_rad.{i}", "+.9f") for i in range(3)],
        "theta_arcsec": [number(f"theta_rad.{i}", "+.4f", scale=TO_ARCSEC) for i in range(3)],
        "euler_deg": [number(f"euler_zxy_deg.{i}", "+.8f") for i in range(3)],
        "sigma_arcsec": [
            number(f"covariance_rad2.{i}.{i}", ".4f", scale=TO_ARCSEC, root=True) for i in range(3)
        ],
        "sigma_rad": [number(f"covariance_rad2.{i}.{i}", ".3e", root=True) for i in range(3)],
        "covariance": [[number(f"covariance_rad2.{i}.{j}", "+.4e") for j in range(3)] for i in range(3)],
        "counts": {name: number(name, ".0f") for name in ("frames", "stars", "targets")},
        "strips": context("strips", ".0f"),
        "chi2": number("chi2", ".2f"),
        "dof": number("dof", ".0f"),
        "chi2_stars": context("chi2_stars", ".1f"),
        "dof_stars": context("dof_stars", ".0f"),
        "noise": {
            name: (context(f"noise.{name}", ".3f"), context(f"noise.{name}_sigma", ".3f"))
            for name in ("stars", "targets")
        },
        "converged": saved.context["converged_matrix"] and saved.context["converged_covariance"],
    }


def _iterations(saved: Saved) -> list[dict[str, Any]]:
    return [
        {
            "step": [
                saved.context_number(f"iterations.{n}.theta_step_rad.{i}", "+.3e", scale=TO_ARCSEC)
                for i in range(3)
            ],
            "chi2": saved.context_number(f"iterations.{n}.chi2", ".2f"),
            "targets": saved.context_number(f"iterations.{n}.targets", ".1f"),
        }
        for n in range(len(saved.context["iterations"]))
    ]


def _matches(saved: Saved, most: int) -> tuple[list[MatchCard], int]:
    """Cards of placed targets, the least believable first when there are too many for the page."""
    rows = {_key(row): n for n, row in enumerate(_keys(saved.targets))}
    found = [(rows.get(_key(row)), n) for n, row in enumerate(_keys(saved.matches))]
    shown = [(row, n) for row, n in found if row is not None]
    if len(shown) > most:
        normalised = column(saved.targets, "normalised")
        worst = np.argsort([-np.nan_to_num(normalised[row], nan=np.inf) for row, _ in shown], kind="stable")
        shown = [shown[k] for k in sorted(worst[:most].tolist())]
    return [_card(saved, row, n) for row, n in shown], len(found)


def _keys(table: Any) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = table.select(["strip_id", "target_id", "ccd"]).to_pylist()
    return rows


def _key(row: dict[str, Any]) -> tuple[str, str, int]:
    return row["strip_id"], row["target_id"], row["ccd"]


def _card(saved: Saved, row: int, n: int) -> MatchCard:
    match = saved.matches.slice(n, 1).to_pylist()[0]
    targets, pictures = "sightings/targets", "evidence/matches"
    return MatchCard(
        f"{match['strip_id']} / {match['target_id']}, CCD {match['ccd']}",
        bool(saved.targets.column("kept")[row].as_py()),
        data_uri("image/png", match["template_png"]),
        data_uri("image/png", match["found_png"]),
        data_uri("image/png", match["surface_png"]),
        saved.cell(targets, "correlation", row, ".3f"),
        saved.cell(targets, "probability_wrong", row, ".1e"),
        saved.cell(targets, "normalised", row, ".2f"),
        saved.cell(pictures, "surface_low", n, "+.2f"),
        saved.cell(pictures, "surface_high", n, "+.2f"),
    )


def _star_image(saved: Saved) -> dict[str, Any] | None:
    about = figures.preview_about(saved)
    if about is None:
        return None
    table, camera = saved.detections, saved.context["star_camera"]
    xy, snr = list_values(table, "xy_px", 2), column(table, "snr")
    state, hip = table.column("state").to_pylist(), column(table, "hip")
    marks = [
        Detection(
            round(float(xy[n, 0]), 3),
            round(float(xy[n, 1]), 3),
            round(0.6 + min(0.3 * float(np.log10(max(snr[n], 1.0))), 0.9), 2),
            state[n],
            (f"HIP {hip[n]}, " if hip[n] else "") + f"signal to noise {snr[n]:.1f}: {STATES[state[n]]}",
            f"HIP {hip[n]}" if hip[n] else "",
        )
        for n in range(len(table))
    ]
    counts = Counter(state)
    shrunk = int(str(about["shrunk"]))
    return {
        "about": about,
        "uri": data_uri("image/jpeg", saved.detections.schema.metadata[b"jpeg"]),
        "width": camera["width_px"] // shrunk * shrunk,
        "height": camera["height_px"] // shrunk * shrunk,
        "marks": marks,
        "counts": {name: counts.get(name, 0) for name in STATES},
        "words": f"Star image {about['exposure_id']} with {len(marks)} detections: "
        + ", ".join(f"{counts.get(name, 0)} {text}" for name, text in STATES.items()),
    }


def _omissions(saved: Saved) -> list[dict[str, str]]:
    rows: list[dict[str, str]] = saved.omissions.slice(0, MOST_ROWS).to_pylist()
    return rows


def _flat(values: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Nested settings as dotted names and values: text as it is, the rest as JSON."""
    if isinstance(values, dict) and values:
        for name, value in values.items():
            yield from _flat(value, f"{path}.{name}" if path else str(name))
    else:
        yield path, values if isinstance(values, str) else json.dumps(values, ensure_ascii=False)


def data_uri(kind: str, content: bytes) -> str:
    """What a page holds of a file, so that it needs no other."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
