"""Stars of strips of the sky as the page lists them: one row, one card and one link each."""

from __future__ import annotations

import math
from typing import Any

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.report.marks import strip_style
from boresight.pipeline.report.observations import KEYS, MOST_PRINTED, SeenCard, pictures_of, rows_by_key
from boresight.pipeline.report.saved import Saved

__all__ = ["strip_star_rows"]

TARGETS = "sightings/targets"  # table of a result, without suffix
CELLS: dict[str, tuple[Any, ...]] = {  # of each number: column, form, factor, whether it is a root
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
                strip_id=row["strip_id"],
                target_id=row["target_id"],
                ccd=row["ccd"],
                state="used" if row["kept"] else "rejected",
                shape=shape,
                colour=colour,
                numbers={name: saved.cell(TARGETS, of[0], n, *of[1:]) for name, of in CELLS.items()},
                pictures=pictures_of(saved, "matches", at, ".0f") if at is not None and seen else None,
                printed=n in printed or not row["kept"],
            )
        )
    return tuple(rows)
