"""Every reader of files from outside given damaged ones: is it read, or is it said what is wrong?

    python benchmarks/fuzz_readers.py --inputs 100000 --seed 1
    python benchmarks/fuzz_readers.py --coverage "orbit.oem" --inputs 20000     # needs atheris

The sound files and the readers are those of tests/pipeline/faults/readers.py. Each reader works in a process
of its own; the damaged file is on disk when it is read, so that it is still there when the process is not. A
finding is any exception but the documented ones, more than 5 s of processor time, 1 GiB more memory, a
process that dies. Findings are kept in --keep. The second form follows the branches of the readers' code.
"""

from __future__ import annotations

import argparse
import faulthandler
import multiprocessing
import platform
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "pipeline" / "faults")]

LONGEST_S = 5
MOST_KIB = 2**20
HANGS_S = 120  # after which a process that does not even take a signal is killed
START_S = 600
SLOW = {"plan, forecast": 0.005}  # share of the inputs of a reader that takes so long
WHOLE_DUMP = 0.4


class TooLong(BaseException):
    """The alarm went off while a file was read."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=100_000, help="in all, or of the one reader")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default=[], nargs="+", help="names of readers; default: all")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-findings"))
    parser.add_argument("--coverage", metavar="READER", help="coverage-guided, with atheris")
    options = parser.parse_args()
    if options.coverage:
        follow_coverage(options.coverage, options.inputs, options.seed)
        return
    from readers import READERS
    from record import commit

    chosen = [reader.name for reader in READERS if not options.only or reader.name in options.only]
    whole = {reader.name for reader in READERS if reader.read is READERS[0].read}
    weights = [SLOW.get(name, WHOLE_DUMP if name in whole else 1.0) for name in chosen]
    shares = [max(1, round(options.inputs * weight / sum(weights))) for weight in weights]
    print(f"commit {commit()}, {time.strftime('%Y-%m-%d')}, command: python {' '.join(sys.argv)}")
    print(f"Python {platform.python_version()}, {platform.platform()}, seed {options.seed}\n")
    titles = ("inputs", "read", "refused", "findings", "longest ms", "s")
    print(f"{'reader':24s}" + "".join(f"{title:>11s}" for title in titles))
    total: Counter[str] = Counter()
    for name, share in zip(chosen, shares):
        counts = tried(name, share, options.seed, options.keep)
        total += counts
        print(
            f"{name:24s}{share:11d}{counts['read']:11d}{counts['refused']:11d}{counts['findings']:11d}"
            f"{counts['longest_us'] / 1e3:11.1f}{counts['seconds']:11d}",
            flush=True,
        )
    print(f"{'in all':24s}{sum(shares):11d}{total['read']:11d}{total['refused']:11d}{total['findings']:11d}")
    raise SystemExit(1 if total["findings"] else 0)


def tried(name: str, inputs: int, seed: int, keep: Path) -> Counter[str]:
    """One reader, in processes that are started again where they died."""
    counts: Counter[str] = Counter()
    begin, done = time.perf_counter(), 0
    context = multiprocessing.get_context("spawn")
    while done < inputs:
        with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
            progress = context.Array("q", 6, lock=False)  # done, read, refused, findings, longest us, restart
            process = context.Process(target=work, args=(name, seed, done, inputs, folder, keep, progress))
            process.start()
            before, since = -1, time.perf_counter()
            while process.is_alive():
                process.join(0.2)
                if progress[0] != before:
                    before, since = progress[0], time.perf_counter()
                elif time.perf_counter() - since > (HANGS_S if before > 0 else START_S):
                    process.kill()
            done += progress[0]
            for key, at in (("read", 1), ("refused", 2), ("findings", 3)):
                counts[key] += progress[at]
            counts["longest_us"] = max(counts["longest_us"], progress[4])
            if process.exitcode and done < inputs:
                saved(keep, name, seed, done, Path(folder), f"the process ended with {process.exitcode}")
                counts["findings"] += 1
                done += 1
    counts["seconds"] = round(time.perf_counter() - begin)
    return counts


def work(name: str, seed: int, first: int, last: int, folder: str, keep: Path, progress: Any) -> None:
    """Inputs first ... last-1 of one reader. A jump of memory ends the process: it is seldom given back."""
    from readers import DOCUMENTED, READERS, mutated, write_sound_files

    faulthandler.enable()
    signal.signal(signal.SIGPROF, alarmed)
    warnings.simplefilter("ignore")
    reader = next(reader for reader in READERS if reader.name == name)
    root = write_sound_files(Path(folder))
    path = root / reader.file
    sound = path.read_bytes()
    reader.read(root)
    for n in range(first, last):
        path.write_bytes(mutated(random.Random(f"{name} {seed} {n}"), sound, reader.is_text))
        held, begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
        trouble = ""
        signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
        try:
            reader.read(root)
            progress[1] += 1
        except DOCUMENTED:
            progress[2] += 1
        except TooLong:
            trouble = f"more than {LONGEST_S} s\n{traceback.format_exc()}"
        except Exception:
            trouble = traceback.format_exc()
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - held
        if more > MOST_KIB:
            trouble += f"{more / 2**20:.1f} GiB more memory"
        if trouble:
            saved(keep, name, seed, n, root, trouble)
            progress[3] += 1
        progress[4] = max(progress[4], int(1e6 * (time.process_time() - begin)))
        progress[0] += 1
        if more > MOST_KIB:
            return


def alarmed(number: int, frame: FrameType | None) -> None:
    raise TooLong


def saved(keep: Path, name: str, seed: int, n: int, root: Path, trouble: str) -> None:
    """The damaged file and what came of it."""
    from readers import READERS

    keep.mkdir(parents=True, exist_ok=True)
    reader = next(reader for reader in READERS if reader.name == name)
    stem = "".join(c if c.isalnum() else "-" for c in name) + f"-{seed}-{n}"
    shutil.copy(root / reader.file, keep / f"{stem}{Path(reader.file).suffix}")
    (keep / f"{stem}.txt").write_text(trouble)
    print(f"  finding: {name}, input {n}: {trouble.strip().splitlines()[-1][:150]}", flush=True)


def follow_coverage(name: str, inputs: int, seed: int) -> None:
    """libFuzzer's mutations, steered by the branches that they reach in the readers' Python code."""
    import atheris

    with atheris.instrument_imports(
        include=[
            "boresight.pipeline.files",
            "boresight.pipeline.run.settings",
            "boresight.features.planning.campaign_plan",
            "oem",
        ]
    ):
        from readers import DOCUMENTED, READERS, write_sound_files
    warnings.simplefilter("ignore")
    reader = next(reader for reader in READERS if reader.name == name)
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        root = write_sound_files(Path(folder) / "sound")
        path = root / reader.file
        corpus = Path(folder) / "corpus"
        corpus.mkdir()
        shutil.copy(path, corpus)

        def read_one(raw: bytes) -> None:
            path.write_bytes(raw)
            try:
                reader.read(root)
            except DOCUMENTED:
                pass

        limits = ["-timeout=5", "-rss_limit_mb=2048", f"-max_len={4 * path.stat().st_size}"]
        atheris.Setup([sys.argv[0], f"-runs={inputs}", f"-seed={seed}", *limits, str(corpus)], read_one)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
