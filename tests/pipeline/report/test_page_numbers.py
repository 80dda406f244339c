"""Every number in the words of a page, beside one computed from the tables of the result and the dump.

Those that stand in a table of the page name their place in the result (`test_report`). A text with a number
that has no row here fails.
"""

import json
import math
import re
import tomllib
from collections.abc import Iterator, Sequence
from html import unescape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.stats import chi2

from boresight.pipeline.results.identity import result_id
from boresight.star_id.finding.star_list import list_stars
from boresight.star_id.settings import StarSettings

DRAWN = re.compile(r"<(script|style|svg|data)\b.*?</\1>", re.DOTALL)
ROW = re.compile(r"<tr data-link[^>]*>\s*<th[^>]*>\s*<a[^>]*>([^<]*)</a></th>(.*?)</tr>", re.DOTALL)
NUMBER = r"([-+]?\d+(?:\.\d+)?)"
PLAIN = re.compile(r"\b1σ|\(1 px|\b1 (?:px|ms|m)$|[CL]E90|SHA-256|\b(?:39|90|95) %|2σ")  # units, names


def rms(values: Any) -> float:
    return math.sqrt(np.mean(np.square(values)))


def words(result: Path, dump: Path) -> Iterator[tuple[str, Sequence[Any]]]:
    """Texts of the page, # for each number, and the numbers."""

    def table(name: str) -> pd.DataFrame:
        return pq.read_table(result / f"{name}.parquet").to_pandas()

    content = json.loads((result / "installation.json").read_text())
    context = json.loads((result / "evidence/context.json").read_text())
    star, line = (tomllib.loads((dump / f"{name}_camera.toml").read_text()) for name in ("star", "remote"))
    ccd, focal_mm = line["ccds"][0], star["focal_length_mm"]
    pitch_rad, wide = 1e-3 * star["pixel_pitch_um"] / focal_mm, star["width_px"]
    height_m = context["altitude_m"]  # by test_evidence.py; some 0.1 % nearer along the look
    ground_m = 1e-6 * ccd["pixel_pitch_um"] / line["focal_length_m"] * height_m
    cameras = "Star camera # × # px, # mm, #° wide. Remote-sensing camera # × # px, # m, # m a pixel on the "
    yield (
        cameras + "ground. Satellite # km above the ellipsoid.",
        [
            *(wide, star["height_px"], focal_mm, math.degrees(2 * math.atan(wide * pitch_rad / 2))),
            *(len(line["ccds"]), ccd["n_px"], line["focal_length_m"], ground_m, 1e-3 * height_m),
        ],
    )
    checks = content["verdict"]["checks"]
    holds, fails = (sum(check[word] for check in checks) for word in ("holds", "fails"))
    made = holds + fails
    yield "Consistent: # of # checks hold, # not applicable.", [holds, made, len(checks) - made]
    yield "# checks", [len(checks)]
    yield r"Of the errors in .* found with probability # .*", [0.9]

    ledger, stars, targets = (table(f"sightings/{name}") for name in ("ledger", "stars", "targets"))
    assert set(ledger.cause) == {"large residual"} and set(ledger.kind) == {"star"}
    yield r"# stars\.?", [len(ledger)]
    yield r"\(# large residual\)\.", [len(ledger)]
    for one in ledger.itertuples():
        others = (stars[stars.exposure_id == one.exposure].kept).sum()
        reason = r"# sigma from the attitude of the other # stars \(chi-square # for # degrees .*, limit #\)"
        yield reason, [math.sqrt(one.statistic), others, one.statistic, 2, one.limit]
    for name, rows in (("stars", stars), ("targets", targets)):
        good = rows[rows.kept]
        numbers = [len(good), good.normalised.mean(), 2, len(rows) - len(good)]
        yield rf"# {name} used, mean # \(# expected\); # rejected\.", numbers
    exposures = table("sightings/exposures")
    mean = (exposures.chi2 / exposures.dof).mean()
    yield r"Attitude fits of # exposures, mean # \(# expected\); band: 2σ\.", [len(exposures), mean, 1]

    ground = table("evidence/ground")
    used = ground[ground.state == "used"]
    radii = np.hypot(used.residual_along_m, used.residual_across_m)
    shown = [len(used), np.percentile(radii, 90)]
    yield r"Residuals of # sightings of targets; circle: CE90 # m\.", shown
    yield r"Mean residual of each of # CCDs, .*", [len(line["ccds"])]
    yield r"Residuals of # targets on the ground against \w+; marks as on the map\.", [len(targets)]

    angles = table("evidence/angles")
    spread = rms(angles.z / angles.sigma)
    yield "# pairs of directions; standard deviation of z/σ #, expected #.", [len(angles), spread, 1]
    groups = np.array_split(angles.sort_values("sigma", kind="stable")[["z", "sigma"]].to_numpy(), 12)
    ratio = [rms(one[:, 0]) / rms(one[:, 1]) for one in groups]
    yield r"# groups of equal prediction; ratio from # to #\. .*", [12, min(ratio), max(ratio)]

    kept = stars[stars.kept]
    off_px = np.vstack(kept.residual_s)[:, :2] / pitch_rad
    cells = pd.DataFrame(np.floor(np.vstack(kept.xy_px) / (wide / 14)), columns=["x", "y"])
    cells[["dx", "dy"]] = off_px
    full = cells.groupby(["x", "y"]).filter(lambda one: len(one) >= 5).groupby(["x", "y"]).mean()
    arrow = np.percentile(np.hypot(full.dx, full.dy), 90)
    nice = min((n * 10.0**p for n in (1, 2, 5) for p in (-3, -2, -1, 0)), key=lambda n: abs(n - arrow))
    told = "Mean residual of # stars in # cells with # or more; the arrow in the corner is # px. "
    numbers = [len(kept), len(full), 5, nice, rms(off_px)]
    yield f"{told}Single stars scatter by # px rms per axis.", numbers
    states = table("evidence/exposure").state.value_counts()
    for state, text in (
        ("used", "identified and used"),
        ("rejected", "identified, rejected as an outlier"),
        ("saturated", "saturated, .*"),
        ("blended", "blended with a neighbour: not used"),
        ("unused", "not identified, or flagged in the catalogue: not used"),
    ):
        yield f"# {text}", [states.get(state, 0)]
    shown = re.search(r"Exposure <strong>(\w+)", (result / "report.html").read_text())[1]
    found = list_stars(cv2.imread(str(dump / f"exposures/{shown}.png"), cv2.IMREAD_UNCHANGED), StarSettings())
    before = [found.hot_pixels, found.misshapen]
    yield r"\. Rejected before detection: # hot pixels, # trails and cosmic rays\..*", before

    sigma = np.sqrt(np.diag(content["covariance_rad2"]))
    arcsec = np.degrees(sigma) * 3600.0
    for a, b in ((0, 1), (0, 2), (1, 2)):
        correlation = content["covariance_rad2"][a][b] / sigma[a] / sigma[b]
        text = f"{'XYZ'[a]}{'XYZ'[b]}: 1σ #″ and #″, correlation #. Solid: .*"
        yield text, [arcsec[a], arcsec[b], correlation]
    settings, facts = leaves(content["settings"]), leaves(json.loads((result / "run.json").read_text()))
    inputs = table("evidence/inputs")
    yield r"# files, listed with .*", [len(inputs)]
    yield r"Input files \(#\)", [len(inputs)]
    yield r"Run and versions \(#\)", [sum(value != "None" for _, value in facts)]
    yield r"Settings \(#\)", [len(settings)]


def names(result: Path) -> set[str]:
    """Texts that are no number of the page: names, dates, settings, sizes and checksums of files."""
    context = json.loads((result / "evidence/context.json").read_text())
    content = json.loads((result / "installation.json").read_text())
    run = json.loads((result / "run.json").read_text())
    tables = [pq.read_table(path) for path in result.glob("*/*.parquet")]
    texts = [one.column(f.name).to_pylist() for one in tables for f in one.schema if f.type == pa.string()]
    known = {text for column in texts for text in column}
    inputs, targets = (
        pq.read_table(result / f"{name}.parquet").to_pylist()
        for name in ("evidence/inputs", "sightings/targets")
    )
    known |= {str(one["bytes"]) for one in inputs}
    known |= {f"{one['file']}, SHA-256 {one['sha256']}" for one in inputs}
    known |= {f"{one['target_id']}, strip {one['strip_id']}, CCD {one['ccd']}" for one in targets}
    known |= {text for pair in leaves(content["settings"]) + leaves(run) for text in pair}
    first, last = (f"{utc[:10]} {utc[11:19]}" for utc in context["utc"])
    known |= {f"{first} to {last[11:]} UTC", f"{first} to {last} UTC"}
    known |= {f"Times are counted from {context['epoch_utc']} UTC.", f"simulated, by {context['created_by']}"}
    known |= {str(n + 1) for n in range(len(context["iterations"]))}
    return known | {f"boresight {run['version']} (commit {run['commit']})", result_id(result)}


def leaves(value: Any, name: str = "") -> list[tuple[str, str]]:
    """Names and values of a JSON object as text."""
    if not isinstance(value, dict):
        return [(name, str(value))]
    return [leaf for key, one in value.items() for leaf in leaves(one, f"{name}.{key}" if name else key)]


def cells(result: Path) -> dict[str, list[str]]:
    """What rows of the tables of exposures and of targets show that is no value of the result itself."""
    tables = {name: pq.read_table(result / f"sightings/{name}.parquet") for name in ("exposures", "targets")}
    stars = pq.read_table(result / "sightings/stars.parquet").to_pandas()
    of_targets = {
        one["target_id"]: [one["strip_id"], str(one["ccd"])] for one in tables["targets"].to_pylist()
    }
    lost = stars[~stars.kept].exposure_id.tolist()
    return of_targets | {
        name: [str(lost.count(name)), f"{chi2(one['dof']).sf(one['chi2']):.2g}"]
        for one in tables["exposures"].to_pylist()
        if (name := one["exposure_id"])
    }


def test_every_number_in_the_words_of_a_page_has_a_row_and_is_right(finished: tuple[Path, Path]) -> None:
    dump, result = finished
    page = DRAWN.sub("", (result / "report.html").read_text())
    found = {
        name: [cell for cell in re.findall(r"<td[^>]*>([^<]*)</td>", row) if re.search(r"\d", cell)]
        for name, row in ROW.findall(page)
    }
    assert {name: [cell.strip() for cell in row] for name, row in found.items()} == cells(result)
    lines = unescape(re.sub(r"<[^>]*>", "\n", ROW.sub("", page))).replace("\N{MINUS SIGN}", "-").splitlines()
    told = {line.strip() for line in lines} - names(result)
    rows = [(re.compile(text.replace("#", NUMBER)), numbers) for text, numbers in words(result, dump)]
    for line in (line for line in told if re.search(r"\d", PLAIN.sub("", line))):
        of_line = [(shown.groups(), numbers) for text, numbers in rows if (shown := text.fullmatch(line))]
        assert of_line, f"no row: {line}"
        assert any(all(map(printed, *one)) for one in of_line), (line, of_line)


def printed(text: str, number: float) -> bool:
    """Whether a number is the one that a text shows, to its last digit."""
    return abs(float(text) - number) <= 0.501 * 10.0 ** -len(text.partition(".")[2])
