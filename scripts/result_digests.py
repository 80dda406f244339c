"""Digests of what the program computes and prints, to prove that a change of structure changes no result.

    python scripts/result_digests.py before.json --dumps build/digest-dumps
    python scripts/result_digests.py after.json --dumps build/digest-dumps --against before.json

Five dumps are calibrated: `fixtures/mini`, `fixtures/sky`, one with two heads that deliver attitudes and
measured points, one of points with the first of these heads alone, and two dumps jointly. The latter are
made by the first call and kept in the folder of dumps, so that both sides read the same bytes. Of every
result the files `installation.json`, `sightings/*.parquet` and `evidence/*.parquet` enter, and the standard
output of the commands that read it; seconds, versions and folders are replaced. With `--experiments` the
tables of quick experiments of the paper are computed as well. The exit status is 1 if a digest differs from
`--against`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NOT_RESULTS = ("version", "command", "made", "created", "commit", "packages", "times")  # keys of JSON files
VERSION = re.compile(
    rb"boresight \d+\.\d+\.\d+\S*( \(commit [^)]*\))?|\d{4}-\d\d-\d\dT[\d:.]+Z?|\d{4}-\d{3}T[\d:.]+"
)
SECONDS = re.compile(r"\b\d+(?:\.\d+)? s\b|\"cpu_ms\": [\d.]+")
PLAN = "[strips]\ncount = 3\n[targets]\ncount = 5\n"
QUICK_EXPERIMENTS = ("inputs", "convergence", "table5")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--dumps", type=Path, required=True, help="folder of the dumps; made where missing")
    parser.add_argument("--against", type=Path, help="digests of another state of the code")
    parser.add_argument("--experiments", action="store_true", help="also tables of the paper")
    options = parser.parse_args()
    make_dumps(options.dumps)
    found = digests(options.dumps.resolve(), options.experiments)
    options.out.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    if options.against is None:
        return 0
    before = json.loads(options.against.read_text(encoding="utf-8"))
    wrong = sorted(name for name in before.keys() | found.keys() if before.get(name) != found.get(name))
    print(f"{len(found)} digests, {len(wrong)} differ", *wrong, sep="\n  ")
    return int(bool(wrong))


def make_dumps(folder: Path) -> None:
    """The five dumps, if they are not there."""
    if folder.is_dir():
        return
    needed = ("handmade_sentinel2.py", "test_joint_heads.py")
    sys.path[:0] = [str(path.parent) for name in needed for path in (ROOT / "tests").rglob(name)]
    import numpy as np
    from test_joint_heads import imported, points, truth, write_imported

    folder.mkdir(parents=True)
    for name in ("mini", "sky"):
        shutil.copytree(ROOT / "fixtures" / name, folder / name)
    with tempfile.TemporaryDirectory() as scratch:
        mission, plain = imported(Path(scratch))
        model, _ = truth(plain)
        half = plain.strips[0].lines // 4
        for name, first in (("heads", 0), ("late", half)):
            strips = tuple(
                replace(one, t_first_row_s=one.t_first_row_s + first * one.row_period_s, lines=half)
                for one in mission.strips
            )
            lines = first + np.linspace(50.0, half - 50.0, 5)
            write_imported(folder / name, replace(mission, strips=strips), points(plain, model, lines, first))
    shutil.copytree(folder / "heads", folder / "points")
    manifest = folder / "points" / "dump.toml"
    before, head, after = manifest.read_text().partition("[[star_cameras]]\n")
    first_head = after.split("[[star_cameras]]\n")[0]
    manifest.write_text(before + head + first_head)


def digests(dumps: Path, experiments: bool) -> dict[str, str]:
    """Name of each file and output to its SHA-256."""
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch)
        (out / "pixels.csv").write_text("ccd,sample,line\n0,12,100\n1,400.5,731.25\n3,20,1500\n")
        (out / "plan.toml").write_text(PLAN)
        runs = {name: [name] for name in ("sky", "mini", "heads", "points")} | {"joint": ["heads", "late"]}
        for name, parts in runs.items():
            sources = [str(dumps / part) for part in parts]
            found[f"{name}: calibrate"] = printed(out, "calibrate", *sources, "--out", name)
            found |= files_of(out / name, name)
            for command in commands_on(name, sources):
                label = " ".join(command).replace(str(dumps), "DUMPS")
                found[f"{name}: {label}"] = printed(out, *command)
        # Exported files, with the program's version, the time of writing and the digest of inputs and program
        # replaced.
        inputs = json.loads((out / "mini" / "run.json").read_text())["inputs"].encode()
        for path in sorted((out / "exported").rglob("*")):
            if path.is_file():
                content = VERSION.sub(b"VERSION", path.read_bytes().replace(inputs, b"INPUTS"))
                found[f"exported: {path.name}"] = sha256(content)
        for label, command in alone(dumps).items():
            found[label] = printed(out, *command)
        for name in QUICK_EXPERIMENTS if experiments else ():
            found[f"experiment {name}"] = printed(out, "experiment", name, "--out", "paper", "--runs", "3")
            found[f"experiment {name}: table"] = sha256((out / "paper" / f"{name}.csv").read_bytes())
    return found


def commands_on(name: str, sources: list[str]) -> list[list[str]]:
    """Commands that read the result called NAME or its dumps."""
    commands = [["status", name], ["status", name, "--json"]]
    if name in ("mini", "sky"):
        commands.append(["validate", name, "--dump", sources[0]])
    if name != "joint":
        commands.append(["dump", "check", sources[0]])
    if name in ("mini", "heads"):
        commands.append(["noise", *sources])
    if name in ("heads", "joint"):
        commands.append(["heads", *sources])
    if name == "mini":
        commands.append(["geolocate", name, "--strip", "s01", "--pixels", "pixels.csv"])
        commands.append(["match", sources[0], "--strip", "s01", "--out", "matches.csv"])
        commands.append(["plan", "plan.toml"])
        commands.append(["remote-camera-calibrate", name, "--out", "interior"])
        commands.append(["compare", name, name, "--html", "compared.html"])
        for kind in ("spice", "aem", "acm", "csm-isd", "rpc", "asp", "qgis", "envi", "geojson", "kml"):
            commands.append(["export", name, "--format", kind, "--out", "exported"])
    return commands


def alone(dumps: Path) -> dict[str, list[str]]:
    """Commands that need no result."""
    exposures = dumps / "mini" / "exposures"
    return {
        "identify": ["identify", str(exposures / "e0001.png"), "--fov", "20", "--json"],
        "identify, unknown field": ["identify", str(exposures / "e0004.png"), "--json"],
        "centroids": ["centroids", str(exposures / "e0002.png")],
        "version": ["--help"],
    }


def printed(folder: Path, *command: str) -> str:
    """Exit status and standard output of a command in a folder, without seconds and paths, as a digest."""
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "100"}
    done = subprocess.run(
        [sys.executable, "-m", "boresight", *command],
        cwd=folder,
        env=os.environ | one_thread,
        capture_output=True,
        text=True,
    )
    text = SECONDS.sub("N s", done.stdout.replace(str(folder), "OUT"))
    if done.returncode not in (0, 1, 3):
        print(f"{' '.join(command)}: exit status {done.returncode}\n{done.stderr[-600:]}", file=sys.stderr)
    return sha256(f"{done.returncode}\n{text}".encode())


def files_of(result: Path, name: str) -> dict[str, str]:
    """Digests of the files of a result."""
    found = {}
    for path in sorted(result.rglob("*")):
        label = f"{name}/{path.relative_to(result).as_posix()}"
        if path.name == "installation.json":
            found[label] = sha256(json.dumps(without(json.loads(path.read_text())), sort_keys=True).encode())
        elif path.suffix == ".parquet" and path.parent.name in ("sightings", "evidence"):
            found[label] = sha256(path.read_bytes())
    return found


def without(value: object) -> object:
    """A JSON value without the keys that are no results."""
    if isinstance(value, dict):
        return {key: without(one) for key, one in value.items() if key not in NOT_RESULTS}
    return [without(one) for one in value] if isinstance(value, list) else value


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
