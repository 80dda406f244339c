"""Stars of strips of the sky as the page lists them: one row, one card and one link each."""

from __future__ import annotations

import math

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.report.marks import strip_style
from boresight.pipeline.report.observations import SeenCard, pictures_of
from boresight.pipeline.report.saved import Number, Saved

__all__ = ["strip_star_rows"]

MOST_PRINTED = 12  # cards of used stars that a print shows
TARGETS = "sightings/targets"  # table of a result, without suffix
SHAPES = {  # of each number: column, element (-1: a plain column), form, factor, whether it is a root
    "sigmas": ("normalised", -1, ".2f", 1.0, True),
    "sample_px": ("xy_px", 0, ".3f", 1.0, False),
    "line_px": ("xy_px", 1, ".3f", 1.0, False),
    "sigma_sample_px": ("cov_px", 0, ".3f", 1.0, True),
    "sigma_line_px": ("cov_px", 3, ".3f", 1.0, True),
    "residual_x": ("residual_c", 0, "+.3f", 1.0 / ARCSEC, False),
    "residual_y": ("residual_c", 1, "+.3f", 1.0 / ARCSEC, False),
}


def strip_star_rows(saved: Saved, most_pictures: int) -> tuple[SeenCard, ...]:
    """All named stars: those rejected, then the others, largest residuals first; at most `most_pictures` of
    those used get pictures.
    """
    table = saved.targets.to_pylist()
    stars = [n for n, row in enumerate(table) if math.isinf(row["range_m"])]
    strips = sorted({table[n]["strip_id"] for n in stars})
    pictured = {
        (row["strip_id"], row["target_id"], row["ccd"]): n
        for n, row in enumerate(saved.matches.select(["strip_id", "target_id", "ccd"]).to_pylist())
    }
    order = sorted(stars, key=lambda n: (table[n]["kept"], -table[n]["normalised"]))
    used = [n for n in order if table[n]["kept"]]
    shown, printed, rows = set(used[:most_pictures]), set(used[:MOST_PRINTED]), []
    for n in order:
        row = table[n]
        at = pictured.get((row["strip_id"], row["target_id"], row["ccd"]))
        shape, colour = strip_style(strips.index(row["strip_id"]))
        rows.append(
            SeenCard(
                row=n,
                link=f"s{n}",
                strip_id=row["strip_id"],
                target_id=row["target_id"],
                ccd=row["ccd"],
                state="used" if row["kept"] else "rejected",
                shape=shape,
                colour=colour,
                numbers=_numbers(saved, n),
                pictures=None
                if at is None or (row["kept"] and n not in shown)
                else pictures_of(saved, "matches", at, ".0f"),
                printed=n in printed or not row["kept"],
            )
        )
    return tuple(rows)


def _numbers(saved: Saved, row: int) -> dict[str, Number]:
    found = {
        "t_s": saved.cell(TARGETS, "t_s", row, "UTC"),
        "probability_wrong": saved.cell(TARGETS, "probability_wrong", row, ".1e"),
    }
    for name, (column, element, form, factor, root) in SHAPES.items():
        cell = saved.targets.column(column)[row].as_py()
        value = float(cell if element < 0 else cell[element])
        found[name] = Number(
            exact=math.sqrt(value) if root else value,
            source=f"{TARGETS}.parquet",
            key=f"{column}.{row}" if element < 0 else f"{column}.{row}.{element}",
            form=form,
            scale=factor,
            root=root,
        )
    return found
