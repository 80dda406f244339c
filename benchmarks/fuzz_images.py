"""Damaged star images of every format given to the reader of `identify`, in one process: no file may end it,
and where Pillow reads a file too the pixels are the same.

    python benchmarks/fuzz_images.py --inputs 10000 --seed 1

The sound images and their mutations are those of tests/pipeline/faults/image_mutants.py. A file is on disk
when it is read, so that it is still there when the process is not. PGM and PPM hold counts, which Pillow
scales to the full range: they are compared after the same scaling.
"""

from __future__ import annotations

import argparse
import random
import resource
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from record import exit_status, head, verdict

TESTS = Path(__file__).resolve().parents[1] / "tests" / "pipeline"
sys.path[:0] = [str(TESTS), str(TESTS / "faults")]

from image_mutants import FORMATS, differs, mutated  # noqa: E402

LONGEST_S = 2.0  # processor time of one file


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=10_000, help="of each format")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=list(FORMATS))
    parser.add_argument("--keep", type=Path, help="folder for files that are findings")
    options = parser.parse_args()
    head("Damaged star images in one process")
    print(f"\n{'format':12s}{'inputs':>9s}{'read':>9s}{'refused':>9s}{'compared':>10s}{'differ':>8s}", end="")
    print(f"{'errors':>8s}{'longest ms':>12s}{'CPU s':>8s}")
    total: Counter[str] = Counter()
    for kind in options.only:
        found, longest_s, spent_s = tried(kind, options.inputs, options.seed, options.keep)
        total += found
        print(f"{kind:12s}{options.inputs:9d}{found['read']:9d}{found['refused']:9d}", end="")
        print(f"{found['compared']:10d}{found['differ']:8d}{found['error']:8d}", end="")
        print(f"{1e3 * longest_s:12.1f}{spent_s:8.1f}", flush=True)
        verdict(f"{kind}: no file takes more than {LONGEST_S:g} s", longest_s <= LONGEST_S)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\nlargest memory {peak:.0f} MiB")
    verdict("no other exception than RawDataError", total["error"] == 0)
    verdict("no difference from Pillow where both read a file", total["differ"] == 0)
    return exit_status()


def tried(kind: str, inputs: int, seed: int, keep: Path | None) -> tuple[Counter[str], float, float]:
    """Counts of outcomes, the longest time of one file and that of all, CPU s."""
    from boresight.pipeline.errors import RawDataError
    from boresight.pipeline.files.images.star_images import read_star_image

    rng, sound = random.Random(f"{seed} {kind}"), FORMATS[kind]()
    found: Counter[str] = Counter()
    longest_s = spent_s = 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image"
        for n in range(inputs):
            content = mutated(rng.choice(sound), rng)
            path.write_bytes(content)
            begun_s = time.process_time()
            try:
                image, outcome = read_star_image(path, "image"), "read"
            except RawDataError:
                image, outcome = None, "refused"
            except Exception as error:
                image, outcome = None, "error"
                print(f"{kind} {n}: {type(error).__name__}: {error}")
            took_s = time.process_time() - begun_s
            longest_s, spent_s = max(longest_s, took_s), spent_s + took_s
            found[outcome] += 1
            wrong = None if image is None else differs(image, content)
            found["compared"] += wrong is not None
            found["differ"] += wrong is True
            if keep is not None and (wrong or outcome == "error" or took_s > LONGEST_S):
                keep.mkdir(parents=True, exist_ok=True)
                (keep / f"{kind.split(',')[0]}-{n}").write_bytes(content)
    return found, longest_s, spent_s


if __name__ == "__main__":
    raise SystemExit(main())
