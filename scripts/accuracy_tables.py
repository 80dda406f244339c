"""The table of accuracy beside the paper's on docs/accuracy.md, from benchmarks/results/table4.csv."""

from __future__ import annotations

import csv
from pathlib import Path

ROOT = Path(__file__).parents[1]
TABLE_4 = ROOT / "benchmarks" / "results" / "table4.csv"
COLUMNS = ("rms_arcsec", "bound_arcsec", "paper_arcsec")


def table4_markdown() -> str:
    """One row a pair of centroid errors: our rms and bound, the size of the paper's error, for X, Y, Z."""
    with TABLE_4.open(newline="") as stream:
        ours = [row for row in csv.DictReader(stream) if row["method"] == "information"]
    cells = {(row["sigma_s_px"], row["sigma_c_px"], row["axis"]): row for row in ours}
    pairs = dict.fromkeys((row["sigma_s_px"], row["sigma_c_px"]) for row in ours)
    rows = []
    for s, c in pairs:
        values = [f"{float(cells[s, c, axis][name]):.4f}" for name in COLUMNS for axis in "XYZ"]
        rows.append(f"| {float(s):.2f}, {float(c):.1f} | " + " | ".join(values) + " |")
    runs, frames = ours[0]["runs"], ours[0]["frames"]
    lines = [
        "| σ_s, σ_c, px | ours: X | Y | Z | bound: X | Y | Z | paper: X | Y | Z |",
        "| --- " * 10 + "|",
        *rows,
        "",
        f"Error in arc-seconds. Ours: rms of {runs} runs of {frames} frames at the level",
        "of vectors, as in the paper's Table 4. Bound: Cramér-Rao. Paper: size of its printed single draws.",
    ]
    return "\n".join(lines) + "\n"
