"""Targets, stars of strips and exposures as the page lists them: one row, one card and one link each."""

from __future__ import annotations

import base64
import math
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.special import chdtrc

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.table_files import column
from boresight.pipeline.report.marks import strip_style
from boresight.pipeline.report.page_template import Number
from boresight.pipeline.report.saved import Saved
from boresight.pipeline.results.summary import REASON_WORDS
from boresight.records.ledger import Kind, State
from boresight.records.record import Floats, record, scalar

__all__ = [
    "Aims",
    "ExposureCard",
    "Pictures",
    "SeenCard",
    "TargetCard",
    "data_uri",
    "exposure_rows",
    "shown_pictures",
    "strip_numbers",
    "strip_star_rows",
    "target_rows",
]

MOST_PRINTED = 12  # cards of used targets or stars that a print shows; those not used are all printed
GROUND, TARGETS = "evidence/ground", "sightings/targets"  # tables of a result, without suffix
STAR_CELLS: dict[
    str, tuple[Any, ...]
] = {  # of each number of a star of a strip: column, form, factor, whether it is a root
    "t_s": ("t_s", "UTC"),
    "probability_wrong": ("probability_wrong", ".1e"),
    "sigmas": ("normalised", ".2f", 1.0, True),
    "sample_px": ("xy_px.0", ".3f"),
    "line_px": ("xy_px.1", ".3f"),
    "sigma_sample_px": ("cov_px.0", ".3f", 1.0, True),
    "sigma_line_px": ("cov_px.3", ".3f", 1.0, True),
    "residual_x": ("residual_c.0", "+.3f", 1.0 / ARCSEC),
    "residual_y": ("residual_c.1", "+.3f", 1.0 / ARCSEC),
}


@record(kw_only=True)
class Aims:
    """Cross-hairs of one picture, (column, row) in its pixels, from its upper left corner."""

    size: tuple[int, int] = scalar("width and height of the picture, px")
    matched: tuple[float, float] | None = scalar("where the target was found")
    predicted: tuple[float, float] | None = scalar("where it was predicted for the search")


@record(kw_only=True)
class Pictures:
    """Pictures of one card as data URIs."""

    template: str = scalar("chip as the strip should show it; of a star the fitted trace")
    found: str = scalar("strip at that place")
    difference: str = scalar("strip minus chip, or trace")
    surface: str = scalar("correlation around that place; empty: of a star")
    low: Number = scalar("lowest correlation of the surface; of a star the counts shown black")
    high: Number = scalar("highest correlation of the surface; of a star the counts shown white")
    aims: Mapping[str, Aims] = scalar("cross-hairs by picture; none of a star")
    off: tuple[Number, ...] = scalar("sample and line found minus predicted; empty: not found")


@record(kw_only=True)
class SeenCard:
    """One target or star in one CCD of a strip, or a target that no strip shows."""

    link: str = scalar("id of its card on the page")
    row: int = scalar("row of evidence/ground.parquet, of a star of sightings/targets.parquet")
    strip_id: str = scalar("strip; empty if none shows it")
    target_id: str = scalar("target, or name of the star")
    ccd: int = scalar("CCD, -1 if unknown")
    state: str = scalar("used, rejected, not matched, not in view")
    shape: str = scalar("mark of its strip")
    colour: str = scalar("CSS class of the colour of its strip")
    numbers: dict[str, Number] = scalar("by name: residual_m, sigmas, correlation ...; those that exist")
    pictures: Pictures | None = scalar("chip or trace, strip, difference, correlation; None: not readable")
    printed: bool = scalar("its card is part of a print")

    @property
    def name(self) -> str:
        """Target or star, strip and CCD in words."""
        where = f", strip {self.strip_id}" if self.strip_id else ""
        return f"{self.target_id}{where}" + (f", CCD {self.ccd}" if self.ccd >= 0 else "")

    @property
    def key(self) -> str:
        """CSS class of the state."""
        return self.state.replace(" ", "-")


@record(kw_only=True)
class TargetCard(SeenCard):
    """A target, with the reason why it is not used."""

    cause: str = scalar("short reason; empty if used")
    reason: str = scalar("sentence with the numbers of the test")

    @property
    def why(self) -> str:
        """The cause in plain words, as on the console."""
        return REASON_WORDS.get(self.cause, self.cause)

    @property
    def words(self) -> str:
        """One line: what it is and what became of it."""
        text = f"{self.name}: {self.state}"
        if "residual_m" in self.numbers:
            text += f", residual {self.numbers['residual_m'].text} m ({self.numbers['sigmas'].text} σ)"
        return f"{text}, {self.why}" if self.cause else text


@record(kw_only=True)
class ExposureCard:
    """One star exposure."""

    link: str = scalar("id of its card on the page")
    exposure_id: str = scalar("exposure")
    state: str = scalar("used, rejected or not identified")
    cause: str = scalar("short reason; empty if used")
    reason: str = scalar("sentence with the numbers")
    numbers: dict[str, Number] = scalar("t_s, stars, chi2, dof; those that exist")
    p_value: float = scalar("of chi2; NaN where there is none")
    rejected: tuple[str, ...] = scalar("stars rejected, one sentence each")

    @property
    def printed(self) -> bool:
        """Whether its card is part of a print."""
        return self.state != "used"


def strip_numbers(saved: Saved) -> dict[str, int]:
    """Strips in the order of the map's scenes, with the numbers of their marks."""
    names = [strip["id"] for scene in saved.context["scenes"] for strip in scene["strips"]]
    return {name: n for n, name in enumerate(names)}


def target_rows(saved: Saved, most_pictures: int) -> tuple[TargetCard, ...]:
    """All targets of evidence/ground.parquet in the order: not used, then used; at most `most_pictures` used
    ones get pictures, those with the largest residuals.
    """
    table = saved.ground.to_pylist()
    number = strip_numbers(saved)
    matched, unmatched, sighted = map(rows_by_key, (saved.matches, saved.unmatched, saved.targets))
    sigmas = np.nan_to_num(column(saved.ground, "sigmas"), nan=np.inf)
    order = sorted(range(len(table)), key=lambda n: (RANK[table[n]["state"]], -sigmas[n]))
    used = [n for n in order if table[n]["state"] == State.USED]
    shown, printed = set(used[:most_pictures]), set(used[:MOST_PRINTED])
    rows = []
    for n in order:
        row, key = table[n], tuple(table[n][name] for name in KEYS)
        pictures = None
        if key in matched and (row["state"] != State.USED or n in shown):
            pictures = pictures_of(saved, "matches", matched[key])
        elif key in unmatched:
            pictures = pictures_of(saved, "unmatched", unmatched[key])
        shape, colour = strip_style(number.get(row["strip_id"], 0))
        rows.append(
            TargetCard(
                link=f"t{n}",
                row=n,
                **{name: row[name] for name in (*KEYS, "state", "cause", "reason")},
                shape=shape,
                colour=colour,
                numbers=_numbers(saved, n, sighted.get(key)),
                pictures=pictures,
                printed=n in printed or row["state"] in (State.REJECTED, State.UNMATCHED),
            )
        )
    return tuple(rows)


# Columns by which rows of two tables belong together, the order of states in tables, and forms of numbers.
KEYS = ["strip_id", "target_id", "ccd"]
RANK = {State.REJECTED: 0, State.UNMATCHED: 1, State.USED: 2, State.OUT_OF_VIEW: 3}
FORMS = {
    "residual_m": ".2f",
    "sigmas": ".2f",
    "residual_along_m": "+.2f",
    "residual_across_m": "+.2f",
    "sample_px": ".2f",
    "line_px": ".2f",
    "t_s": "UTC",
    "lat_deg": ".6f",
    "lon_deg": ".6f",
    "height_m": ".1f",
}
# Columns of sightings/targets.parquet that a card shows, and the forms of their numbers.
SIGHTED = {"correlation": ".3f", "probability_wrong": ".1e", "detectable_m": ".2f"}


def rows_by_key(table: pa.Table) -> dict[tuple[Any, ...], int]:
    """Rows of a table by their `KEYS`."""
    return {key: n for n, key in enumerate(zip(*(table.column(name).to_pylist() for name in KEYS)))}


def _numbers(saved: Saved, row: int, sighted: int | None) -> dict[str, Number]:
    found = {name: saved.cell(GROUND, name, row, form) for name, form in FORMS.items()}
    if sighted is not None:
        found |= {name: saved.cell(TARGETS, name, sighted, form) for name, form in SIGHTED.items()}
    return {name: number for name, number in found.items() if np.isfinite(number.exact)}


def pictures_of(saved: Saved, table: str, n: int, form: str = "+.2f") -> Pictures | None:
    """Pictures of a row of evidence/`table`; None where it holds none. `form` is that of its numbers."""
    row = getattr(saved, table).slice(n, 1).to_pylist()[0]
    return shown_pictures(row, lambda name: saved.cell(f"evidence/{table}", name, n, form))


def shown_pictures(row: Mapping[str, Any], number: Callable[[str], Number]) -> Pictures | None:
    """The pictures that a row of evidence/matches or evidence/unmatched holds, None where it holds none;
    `number` gives its numbers by their columns. A star has no correlation.
    """
    if not row["template_png"]:  # measured elsewhere
        return None
    parts = {name: row[f"{name}_png"] for name in ("template", "found", "difference", "surface")}
    off = [number(f"off_{axis}_px") for axis in "xy"]
    return Pictures(
        **{name: data_uri("image/png", png) if png else "" for name, png in parts.items()},
        low=number("surface_low"),
        high=number("surface_high"),
        aims=_aims(row) if parts["surface"] else {},
        off=tuple(off) if np.isfinite(off[0].exact) else (),
    )


def _aims(row: Mapping[str, Any]) -> dict[str, Aims]:
    """Cross-hairs of chip, strip and correlation of a row of evidence/matches or evidence/unmatched."""
    place, off, peak = (np.array([row[f"{name}_x{px}"], row[f"{name}_y{px}"]]) for name, px in PLACES)
    at = {"found": (place, place - off), "surface": (peak + off, peak)}
    if np.isfinite(off).all():
        at["template"] = place, np.full(2, np.nan)
    else:  # what is shown is the predicted place
        at |= {"template": (off, place), "found": (off, place)}
    aims = {}
    for name, (matched, predicted) in at.items():
        width, height = struct.unpack(">II", row[f"{name}_png"][16:24])  # as the PNG states them
        aims[name] = Aims(size=(width, height), matched=_corner(matched), predicted=_corner(predicted))
    return aims


PLACES = ("place", ""), ("off", "_px"), ("surface", "")


def _corner(at: Floats) -> tuple[float, float] | None:
    """A place from the corner of the first pixel instead of its middle; None for NaN."""
    x, y = (round(float(value) + 0.5, 2) for value in at)
    return (x, y) if np.isfinite(x) else None


def exposure_rows(saved: Saved) -> tuple[ExposureCard, ...]:
    """All identified exposures in order of time, then those that could not be used; none where the star
    camera delivers attitudes.
    """
    if saved.context["star_camera"] is None:
        return ()
    stars: dict[str, list[str]] = {}
    reasons: dict[str, tuple[str, str]] = {}
    for row in saved.ledger.to_pylist():
        if row["kind"] == Kind.STAR:
            stars.setdefault(row["exposure"], []).append(f"HIP {row['id']}: {row['reason']}")
        elif row["kind"] == Kind.EXPOSURE:
            reasons[row["exposure"]] = (row["cause"], row["reason"])
    table, names = "sightings/exposures", saved.exposures.column("exposure_id").to_pylist()
    usable = saved.exposures.column("usable").to_pylist()
    forms = {"t_s": "UTC", "stars": ".0f", "chi2": ".1f", "dof": ".0f"}
    states = ["used" if good else "rejected" for good in usable]
    rows = []
    for n, name in enumerate(dict.fromkeys([*names, *reasons])):
        state = states[n] if n < len(names) else "not used"
        cells = forms.items() if n < len(names) else ()
        numbers = {key: saved.cell(table, key, n, form) for key, form in cells}
        dof = numbers["dof"].exact if numbers else 0.0
        cause, reason = reasons.get(name, ("", "")) if state != "used" else ("", "")
        rows.append(
            ExposureCard(
                link=f"e{n}",
                exposure_id=name,
                state=state,
                cause=cause,
                reason=reason,
                numbers=numbers,
                p_value=float(chdtrc(dof, numbers["chi2"].exact)) if dof > 0 else float("nan"),
                rejected=tuple(stars.get(name, ())),
            )
        )
    return tuple(rows)


def data_uri(kind: str, content: bytes) -> str:
    """Bytes as a `data:` URI of the media type `kind`, so that a page needs no other file."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def strip_star_rows(saved: Saved, most_pictures: int) -> tuple[SeenCard, ...]:
    """All named stars: those rejected, then the others, largest residuals first; at most `most_pictures` of
    those used get pictures.
    """
    table = saved.targets.to_pylist()
    stars = [n for n, row in enumerate(table) if math.isinf(row["range_m"])]
    strips = sorted({table[n]["strip_id"] for n in stars})
    pictured = rows_by_key(saved.matches)
    order = sorted(stars, key=lambda n: (table[n]["kept"], -table[n]["normalised"]))
    used = [n for n in order if table[n]["kept"]]
    shown, printed, rows = set(used[:most_pictures]), set(used[:MOST_PRINTED]), []
    for n in order:
        row = table[n]
        at = pictured.get(tuple(row[name] for name in KEYS))
        seen = not row["kept"] or n in shown
        shape, colour = strip_style(strips.index(row["strip_id"]))
        rows.append(
            SeenCard(
                row=n,
                link=f"s{n}",
                **{name: row[name] for name in KEYS},
                state="used" if row["kept"] else "rejected",
                shape=shape,
                colour=colour,
                numbers={name: saved.cell(TARGETS, of[0], n, *of[1:]) for name, of in STAR_CELLS.items()},
                pictures=pictures_of(saved, "matches", at, ".0f") if at is not None and seen else None,
                printed=n in printed or not row["kept"],
            )
        )
    return tuple(rows)
