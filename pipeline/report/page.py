"""Report page of one dump: figures, tables and pictures in one HTML file without external resources; where
its data do not suffice, a page that says what is missing.
"""

from __future__ import annotations

import functools
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from boresight.geometry.constants import ARCSEC
from boresight.pipeline import __version__
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.table_files import column, list_values
from boresight.pipeline.files.text_tables import leaves
from boresight.pipeline.files.whole_file import write_text, write_whole
from boresight.pipeline.report import figures, observations
from boresight.pipeline.report.budget_table import budget_rows
from boresight.pipeline.report.first_screen import first_screen
from boresight.pipeline.report.map_view import map_view
from boresight.pipeline.report.marks import SHAPES, strip_style
from boresight.pipeline.report.page_template import Number, number_from, template
from boresight.pipeline.report.saved import Saved, read_saved
from boresight.pipeline.report.sheet import basis_of, matrix_numbers
from boresight.pipeline.report.star_image import star_detection, star_picture
from boresight.pipeline.report.star_preview import STATES
from boresight.pipeline.report.strips_on_sky import strips_on_sky
from boresight.pipeline.report.verdict_section import verdict_view
from boresight.pipeline.results.folder import INTERIOR, VALIDATION

__all__ = ["report_parts", "write_no_result", "write_report"]

MOST_MATCHES = 200  # used targets with pictures: more make the page too large for a browser
MOST_ROWS = 300  # shown of a long table
TO_ARCSEC = 1.0 / ARCSEC  # arcsec in a radian


def write_report(result: Path) -> Path:
    """Write `report.html` into the folder of a result and return its path.

    Raises `RawDataError` naming a file of the result that is missing or damaged.
    """
    parts = report_parts(read_saved(result))
    path = result / "report.html"

    def write(target: Path) -> None:
        with target.open("w", encoding="utf-8") as file:
            file.writelines(parts)

    write_whole(path, write)
    return path


def report_parts(saved: Saved, most_matches: int = MOST_MATCHES) -> Iterator[str]:
    """The report as HTML, part by part: with thousands of targets tens of MB, as one text twice that.
    Of used targets `most_matches` are pictured, the largest residuals first.
    """
    targets, exposures = observations.target_rows(saved, most_matches), observations.exposure_rows(saved)
    strip_stars = observations.strip_star_rows(saved, most_matches)
    of: Any = template("observations.html.j2").module
    every = ((of.target_card, targets), (of.exposure_card, exposures), (of.star_card, strip_stars))
    more_cards = {row.link: str(card(row)) for card, rows in every for row in rows if not row.printed}
    return template("page.html.j2").generate(
        saved=saved,
        summary=_summary(saved),
        verdict=verdict_view(saved.installation),
        basis=basis_of(saved.context, "evidence/context.json", saved.inputs),
        first=first_screen(saved, targets),
        map=map_view(saved, targets),
        targets=targets,
        strip_stars=strip_stars,
        exposures=exposures,
        more_cards=more_cards,
        shapes=SHAPES,
        accuracy=_by_strip(saved, saved.context["accuracy"], saved.context_number),
        checked=_checked(saved),
        budget=budget_rows(saved.context, saved.installation),
        predicted={
            part: [saved.context_number(f"new_strip.{part}.{i}", ".2f") for i in (0, 1)]
            for part in ("sigma_m", "le90_m")
        },
        **_figures(saved, targets, exposures, strip_stars),
        interior=_interior(saved),
        seen_in=" and ".join(name for name, one in (("targets", targets), ("stars", strip_stars)) if one)
        or "targets",
        iterations=_iterations(saved),
        image=_star_image(saved),
        states=STATES,
        omissions=saved.ledger.slice(0, MOST_ROWS).to_pylist(),
        omissions_in_all=len(saved.ledger),
        kinds=sorted(Counter(saved.ledger.column("kind").to_pylist()).items()),
        settings=_texts(saved.installation["settings"]),
        facts=_texts({k: v for k, v in saved.run.items() if v is not None}),
        inputs=saved.inputs.slice(0, MOST_ROWS).to_pylist(),
        inputs_in_all=len(saved.inputs),
        most_rows=MOST_ROWS,
    )


def _figures(
    saved: Saved,
    targets: Sequence[observations.TargetCard],
    exposures: Sequence[observations.ExposureCard],
    strip_stars: Sequence[observations.SeenCard],
) -> dict[str, Any]:
    """Drawings by their names in the page's template; of stars and of targets where there are any."""
    has_stars = saved.context["star_camera"] is not None
    seen = "stars of strips" if strip_stars and not targets else "targets"
    statistics = [
        figures.squared_residual_histogram(saved, "stars", "stars") if has_stars else None,
        figures.squared_residual_histogram(saved, "targets", seen),
        figures.exposure_chi2(saved, exposures) if has_stars else None,
        figures.allan_plot(saved),
        figures.attitudes_in_time(saved),
    ]
    return {
        "convergence": figures.convergence(saved),
        "ellipses": figures.covariance_ellipses(saved),
        "on_sky": strips_on_sky(saved, strip_stars),
        "angles": [figures.angle_histogram(saved), figures.angle_spread(saved)] if has_stars else [],
        "star_map": figures.star_residual_map(saved) if has_stars else None,
        "statistics": [drawing for drawing in statistics if drawing is not None],
        "residuals": figures.residual_panels(saved, targets) if targets or not strip_stars else [],
        "star_residuals": figures.star_residual_panels(saved, strip_stars) if strip_stars else [],
    }


def _summary(saved: Saved) -> dict[str, Any]:
    number, context = saved.number, saved.context_number
    return {
        **matrix_numbers(saved.installation, "installation.json"),
        "counts": {name: number(name, ".0f") for name in ("frames", "stars", "targets")},
        "strips": context("strips", ".0f"),
        "chi2": number("chi2", ".2f"),
        "dof": number("dof", ".0f"),
        "chi2_stars": context("chi2_stars", ".1f"),
        "dof_stars": context("dof_stars", ".0f"),
    }


def _iterations(saved: Saved) -> Iterator[list[Number]]:
    """Step of theta about X, Y, Z, arcsec, chi2 and targets of each iteration."""
    number = saved.context_number
    for n in range(len(saved.context["iterations"])):
        at = f"iterations.{n}"
        step = [number(f"{at}.theta_step_rad.{i}", "+.3e", scale=TO_ARCSEC) for i in range(3)]
        yield [*step, number(f"{at}.chi2", ".2f"), number(f"{at}.targets", ".1f")]


def _checked(saved: Saved) -> dict[str, Any] | None:
    """Errors against the truth: of the matrix, and at the check points; None where it was not compared."""
    content = saved.validation
    if not content:
        return None
    number = functools.partial(number_from, content, VALIDATION)
    return {
        "error": [number(f"error_rad.{i}", "+.4f", scale=TO_ARCSEC) for i in range(3)],
        "sigma": [number(f"sigma_rad.{i}", ".4f", scale=TO_ARCSEC) for i in range(3)],
        "nees": number("nees", ".2f"),
        "rows": _by_strip(saved, content["accuracy"], number),
        "predicted": [
            {
                "direction": one["direction"],
                "found": number(f"predicted.{n}.rms_m", ".2f"),
                "predicted": number(f"predicted.{n}.predicted_m", ".2f"),
                "p": number(f"predicted.{n}.p_value", ".2g"),
                "allowed": one["allowed"],
            }
            for n, one in enumerate(content.get("predicted", ()))
        ],
    }


def _interior(saved: Saved) -> dict[str, Any] | None:
    """What `remote-camera-calibrate` wrote into the folder: numbers and picture; None where it did not."""
    content = saved.interior
    if not content:
        return None
    number = functools.partial(number_from, content, INTERIOR)
    return {
        "change": number("map_change_rms_px", ".3f"),
        "sigma": number("map_sigma_rms_px", ".3f"),
        "strips": number("strips", ".0f"),
        "gauge": [f"{one['name']} (not told from {one['not_told_from']})" for one in content["gauge"]],
        "picture": observations.data_uri("image/png", saved.interior_png) if saved.interior_png else "",
    }


def _by_strip(
    saved: Saved, accuracy: list[dict[str, Any]], number: Callable[[str, str], Number]
) -> list[dict[str, Any]]:
    """Residuals on the ground of all strips (name empty) and of each: rows of `accuracy_rows`, of which
    `number` gives the numbers.
    """
    order, rows = observations.strip_numbers(saved), []
    for n, one in enumerate(accuracy):
        name, parts = one["strip_id"], ("rms_m.0", "rms_m.1", "ce90_m", "le90_m.0", "le90_m.1")
        numbers = [number(f"accuracy.{n}.{part}", ".2f") for part in parts]
        count = number(f"accuracy.{n}.n", ".0f")
        rows.append({"name": name, "style": strip_style(order.get(name, 0)), "numbers": [count, *numbers]})
    return rows


def _star_image(saved: Saved) -> dict[str, Any] | None:
    metadata = saved.detections.schema.metadata or {}
    if b"about" not in metadata:
        return None
    about = json.loads(metadata[b"about"])
    table, camera = saved.detections, saved.context["star_camera"]
    places, names = list_values(table, "xy_px", 2).tolist(), table.column("hip").to_pylist()
    found = zip(places, column(table, "snr"), table.column("state").to_pylist(), names)
    marks = [
        star_detection(round(x, 3), round(y, 3), snr, state, STATES, f"HIP {hip}" if hip else "")
        for (x, y), snr, state, hip in found
    ]
    size_px = camera["width_px"], camera["height_px"]
    picture = star_picture(metadata[b"jpeg"], int(str(about["shrunk"])), size_px, marks, STATES)
    seen = ", ".join(f"{picture['counts'][name]} {text}" for name, text in STATES.items())
    words = f"Star image {about['exposure_id']} with {len(marks)} detections: {seen}"
    return picture | {"about": about, "words": words}


def _texts(values: dict[str, Any]) -> list[tuple[str, str]]:
    """Nested settings as (dotted name, value): text unchanged, all else as JSON."""
    of_name = leaves(values)
    return [(name, v if isinstance(v, str) else json.dumps(v, ensure_ascii=False)) for name, v in of_name]


def write_no_result(result: Path, dump: Dump, error: DataNotSufficientError) -> Path:
    """Write `report.html` of a run without a result; its path."""
    cause, *rest = str(error).split("; ")
    every = (*dump.strips, *dump.sky_strips)
    begin = min(strip.t_first_row_s for strip in every)
    end = max(strip.t_first_row_s + strip.lines * strip.row_period_s for strip in every)
    exposures = sum(len(head.t_s) for head in dump.heads)
    rows = [entry.row for entry in error.omissions]
    text = template("no_result.html.j2").render(
        mission=dump.mission,
        satellite=dump.satellite,
        utc=[utc[:19].replace("T", " ") for utc in dump.epoch.utc_from_seconds([begin, end])],
        counts={"exposures": exposures, "strips": len(dump.strips), "targets": len(dump.targets)},
        cause=cause,
        rest=rest,
        kinds=sorted(Counter((row["kind"], row["cause"]) for row in rows).items()),
        omissions=rows[:MOST_ROWS],
        omissions_in_all=len(rows),
        version=__version__,
    )
    write_text(path := result / "report.html", text)
    return path
