"""Damaged and hostile input: is it read, or is it said what is wrong, and is a wrong result ever green?

    python benchmarks/fuzz.py dumps [--count 24] [--dump sky] [--field x_offset_mm]
    python benchmarks/fuzz.py readers [--count 4000] [--only orbit.oem]
    python benchmarks/fuzz.py images [--count 300] [--only PNG]
    python benchmarks/fuzz.py door [--count 800]

`dumps`: one number in one text file of `fixtures/mini` or `fixtures/sky` is changed (factor, sign, decimal
point, a digit, two digits exchanged, 0, -1, nan, 1e308; of a chosen field every other time by 1 to 1e-5 of
itself) and the dump is calibrated, with its result and where the result is unusual its page, under limits of
memory and time; what is unchanged comes from a store. A result is wrong whose normalised error squared (NEES)
is above 30 although the verdict is "consistent", unless the attitude of the remote-sensing camera in space is
unchanged (then the error is a rotation of the star camera's axes, which no data reveal) or the result says
that it cannot see the input.

`readers`: every reader of files from outside, with the sound files and mutations of
`tests/pipeline/faults/readers.py`. A finding is any exception but the documented ones, 5 s of processor time,
1 GiB more memory, or a process that dies. `images`: star images of every format (`image_mutants.py`), held
against Pillow's pixels where both read a file. `door`: hostile arguments for every public function
(`tests/api/hostile_calls.py`). With --keep what is found is written into a folder.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import logging
import multiprocessing
import os
import random
import re
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
from typing import Any

from record import ROOT, exit_status, head, judge_largest, judge_share

TESTS = ROOT / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "pipeline"), str(TESTS / "pipeline" / "faults"), str(TESTS / "api")]

WHAT = {"dumps": 24, "readers": 4000, "images": 300, "door": 800}  # and how many by default


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=WHAT)
    parser.add_argument("--count", type=int, help="mutations; of images for each format")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--dump", choices=("mini", "sky"), default="mini", help="of fixtures/")
    parser.add_argument("--field", default="", help="only numbers of this field, such as x_offset_mm")
    parser.add_argument("--only", default=[], nargs="+", help="names of readers, or formats of images")
    parser.add_argument("--keep", type=Path, help="folder for inputs that are findings")
    options = parser.parse_args()
    options.count = options.count or WHAT[options.what]
    warnings.simplefilter("ignore")
    head(f"Damaged and hostile input: {options.what}")
    {"dumps": dumps, "readers": readers, "images": images, "door": door}[options.what](options)
    return exit_status()


def kept(options: argparse.Namespace, name: str, content: bytes, trouble: str) -> None:
    """Print a finding and keep its input where that is asked."""
    print(f"  finding: {name}: {trouble.strip().splitlines()[-1][:200]}", flush=True)
    if options.keep:
        options.keep.mkdir(parents=True, exist_ok=True)
        (options.keep / re.sub(r"\W", "-", name)).write_bytes(content)


# ---- dumps ----

TEXTS = {  # file: weight
    "dump.toml": 1,
    "star_camera.toml": 2,
    "remote_camera.toml": 3,
    "installation.toml": 1,
    "orbit.oem": 3,
    "exposures.csv": 2,
    "strips.csv": 2,
    "targets.csv": 3,
}
NUMBER = re.compile(r"(?<![\w.])[+-]?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?(?![A-Za-z_])")
LIMIT_BYTES, LIMIT_CPU_S, LIMIT_S, LIMIT_NEES = 4 * 2**30, 120, 3600, 30.0
ORDINARY_NEES = 1.0  # a NEES that differs by more from that of the sound dump is worth a page
LIMIT_ROTATION_SIGMA = 1.0  # of the remote-sensing camera in space, for an error that is a rotation of axes
BLIND = {  # field: regular expression of an entry of what a result says that it cannot see
    "utc_first_row|time_of_row|tdi_stages|utc_mid": "clock|late",
    "row_period_s": "period",
    "x_offset_mm|y_first_mm|rotation_mrad": "ccd",
    "focal_length_mm?": "focal",
    "principal_point_px": "principal",
    "height_m": "height|radial",
}


def dumps(options: argparse.Namespace) -> None:
    """Calibrate copies of a dump with one number changed."""
    from fault_cases import true_rotation

    from boresight.pipeline.calibration.calibrate import calibrate_dump
    from boresight.pipeline.files.dump import open_dump
    from boresight.pipeline.run.unit_store import UnitStore

    count: Counter[str] = Counter()
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as name:
        folder, fixture = Path(name), ROOT / "fixtures" / options.dump
        shutil.copytree(fixture, folder / "dump")
        sound = calibrate_dump(open_dump(folder / "dump"), None, UnitStore(folder / "store"))
        R_true = true_rotation(folder / "dump")
        texts = {name: (fixture / name).read_text() for name in TEXTS if (fixture / name).is_file()}
        texts = {name: text for name, text in texts.items() if spans_of(text, options.field)}
        for n in range(options.count):
            (name,) = rng.choices(list(texts), [TEXTS[one] for one in texts])
            where, field, text = one_number_changed(texts[name], name, rng, options.field)
            (folder / "dump" / name).write_text(text)
            answer = in_process(folder, sound, R_true)
            (folder / "dump" / name).write_text(texts[name])
            outcome = answer["outcome"]
            if outcome.startswith("consistent") and answer["nees"] > LIMIT_NEES:
                outcome = "told" if is_told(field, answer) else "green while wrong"
            count[outcome] += 1
            print(f"{name}:{where}  {outcome}  {answer['says'][:120]}", flush=True)
            if outcome in ("traceback", "hang", "died", "green while wrong"):
                kept(options, f"{n}-{name}", text.encode(), f"{where} {outcome} {answer['says']}")
    print(", ".join(f"{n} {kind}" for kind, n in count.most_common()))
    for kind in ("traceback", "hang", "died", "green while wrong"):
        judge_share(f"one number of {options.dump} changed: {kind}", count[kind], options.count, most=0.0)


def is_told(field: str, answer: dict[str, Any]) -> bool:
    """Whether a large error is one of axes alone, or among what the result says that it cannot see."""
    words = [word for fields, word in BLIND.items() if re.fullmatch(fields, field)]
    return answer["rotation_in_space_sigma"] <= LIMIT_ROTATION_SIGMA or any(
        re.search(word, spot.lower()) for word in words for spot in answer["blind"]
    )


def spans_of(text: str, field: str) -> list[tuple[int, int]]:
    """Where the numbers of a text are; with a field those in lines that begin with it."""
    spans = [match.span() for match in NUMBER.finditer(text)]
    return [span for span in spans if text[text.rfind("\n", 0, span[0]) + 1 :].startswith(field)]


def one_number_changed(text: str, name: str, rng: random.Random, field: str) -> tuple[str, str, str]:
    """Where and how a number was changed, its field, and the text with it changed."""
    begin, end = rng.choice(spans_of(text, field))
    old = text[begin:end]
    change = slightly_changed if field and rng.random() < 0.5 else changed
    while (new := change(old, rng)) == old:
        pass
    line = text.count("\n", 0, begin) + 1
    where = text[text.rfind("\n", 0, begin) + 1 : begin]
    if name.endswith(".csv"):
        column = text.splitlines()[0].split(",")[where.count(",")] if line > 1 else "header"
    else:
        column = where.partition(" ")[0]
    return f"{line} {column} {old} -> {new}", column, text[:begin] + new + text[end:]


def slightly_changed(old: str, rng: random.Random) -> str:
    """A number's text a little larger or smaller."""
    return f"{float(old) * (1.0 + rng.choice((-1.0, 1.0)) * 10.0 ** -rng.uniform(0.0, 5.0)):.12g}"


def changed(old: str, rng: random.Random) -> str:
    """A number's text with one thing about it changed."""
    kind = rng.randrange(8)
    if kind == 0:
        value = float(old) * rng.choice((10.0, 0.1, 2.0, 0.5, 1.1, 1.01, 1.001, 1.0001))
        return f"{value:.0f}" if re.fullmatch(r"[+-]?\d+", old) else f"{value:.12g}"
    if kind == 1:
        return old[1:] if old.startswith(("-", "+")) else f"-{old}"
    if kind == 2:
        return rng.choice(("0", "-1", "nan", "1e308", "9e15", "-1e308"))
    places = [n for n, c in enumerate(old) if c.isdigit()]
    at = rng.choice(places)
    if kind in (3, 4):
        return old[:at] + str(rng.randrange(10)) + old[at + 1 :]
    if kind == 5 and at + 1 in places:
        return old[:at] + old[at + 1] + old[at] + old[at + 2 :]
    if kind == 6 and "." in old:
        digits = old.replace(".", "")
        return digits if rng.random() < 0.5 else digits[:at] + "." + old[at:].replace(".", "")
    return old[:at] + old[at + 1 :] if len(places) > 1 else f"{old}0"


def in_process(folder: Path, sound: Any, R_true: Any) -> dict[str, Any]:
    """Outcome of a calibration in a process of its own."""
    read_end, write_end = os.pipe()
    if not (child := os.fork()):
        os.close(read_end)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(LIMIT_S)
        resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_CPU_S, LIMIT_CPU_S))  # SIGKILL
        resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
        os.write(write_end, json.dumps(outcome_of(folder, sound, R_true)).encode())
        os._exit(0)
    os.close(write_end)
    with os.fdopen(read_end, "rb") as stream:
        answer = stream.read()
    _, status = os.waitpid(child, 0)
    shutil.rmtree(folder / "result", ignore_errors=True)
    if not answer:
        by = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        hang = by in (signal.SIGALRM, signal.SIGXCPU, signal.SIGKILL)
        return {"outcome": "hang" if hang else "died", "says": f"status {status}"}
    return json.loads(answer)


def outcome_of(folder: Path, sound: Any, R_true: Any) -> dict[str, Any]:
    """Refused, not sufficient, a traceback, or a result with its NEES and verdict."""
    from fault_cases import blind_spots

    from boresight.calib.verdict import Outcome
    from boresight.pipeline.calibration.calibrate import calibrate_dump
    from boresight.pipeline.errors import DataNotSufficientError, RawDataError
    from boresight.pipeline.files.dump import open_dump
    from boresight.pipeline.files.text_files import read_json
    from boresight.pipeline.report.evidence import write_evidence
    from boresight.pipeline.report.page import write_report
    from boresight.pipeline.results.folder import begin_result
    from boresight.pipeline.results.writing import write_result
    from boresight.pipeline.run.settings import Settings
    from boresight.pipeline.run.unit_store import UnitStore

    class Finished(UnitStore):
        """A store that is only read: it keeps the units of the sound dump."""

        def write(self, *arguments: Any) -> Path:
            return self.root

    try:
        dump = open_dump(folder / "dump")
        found = calibrate_dump(dump, None, Finished(folder / "store"))
        expected, nees = (nees_of(one, R_true) for one in (sound, found))
        result = folder / "result"
        result.mkdir()
        begin_result(result)
        write_evidence(result, dump, found, Settings())
        write_result(result, found, Settings())
        if found.verdict.outcome is Outcome.REFUTED or abs(nees - expected) > ORDINARY_NEES:
            (result / "run.json").write_text('{"dump": "mutated"}')
            write_report(result)
        return {
            "outcome": found.verdict.outcome.value,
            "says": ", ".join(check.kind.name for check in found.verdict.refuted_by),
            "nees": nees,
            "blind": blind_spots(read_json(result / "installation.json")),
            "rotation_in_space_sigma": rotation_in_space(found, sound),
        }
    except (RawDataError, DataNotSufficientError) as error:
        kind = "refused" if isinstance(error, RawDataError) else "not sufficient"
        return {"outcome": kind, "says": str(error)[:300]}
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {str(error)[:200]} ({Path(place.filename).name}:{place.lineno})"
        return {"outcome": "traceback", "says": text}


def nees_of(found: Any, R_true: Any) -> float:
    """Normalised error squared of the three angles."""
    import numpy as np

    from boresight.geometry.installation import theta_between

    error = theta_between(found.estimate.R_cs, R_true)
    return float(error @ np.linalg.solve(found.estimate.cov_theta, error))


def rotation_in_space(found: Any, sound: Any) -> float:
    """Rotation of the remote-sensing camera in space against the sound dump's, in units of its 1-sigma."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    places = {star.t_s: k for k, star in enumerate(sound.stars)}
    both = [(k, places[star.t_s]) for k, star in enumerate(found.stars) if star.t_s in places]
    both = [(k, m) for k, m in both if found.attitudes.usable[k] and sound.attitudes.usable[m]]
    if not both:
        return float("inf")
    R_ci, R_ci_sound = (
        one.estimate.R_cs * Rotation.from_matrix(one.attitudes.R_si[list(rows)])
        for one, rows in zip((found, sound), zip(*both))
    )
    rotation = np.median((R_ci * R_ci_sound.inv()).as_rotvec(), axis=0)
    return float(np.sqrt(rotation @ np.linalg.solve(sound.estimate.cov_theta, rotation)))


# ---- readers ----

LONGEST_S, MOST_KIB = 5, 2**20
HANGS_S, START_S = 120, 600  # after which a process that does not even take a signal is killed
SLOW, WHOLE_DUMP = {"plan, forecast": 0.005}, 0.4  # shares of the inputs of readers that take long


class TooLong(BaseException):
    """The alarm went off while a file was read."""


def readers(options: argparse.Namespace) -> None:
    """All readers, each in a process of its own that is started again where it died."""
    from readers import READERS

    chosen = [reader.name for reader in READERS if not options.only or reader.name in options.only]
    whole = {reader.name for reader in READERS if reader.read is READERS[0].read}
    weights = [SLOW.get(name, WHOLE_DUMP if name in whole else 1.0) for name in chosen]
    shares = [max(1, round(options.count * weight / sum(weights))) for weight in weights]
    total: Counter[str] = Counter()
    print(f"{'reader':24s}     inputs       read    refused   findings longest ms")
    for name, inputs in zip(chosen, shares):
        counts = tried(name, inputs, options)
        total += counts
        figures = "".join(f"{counts[key]:11d}" for key in ("read", "refused", "findings"))
        print(f"{name:24s}{inputs:11d}{figures}{counts['longest_us'] / 1e3:11.1f}", flush=True)
    judge_share("damaged files: findings", total["findings"], sum(shares), most=0.0)


def tried(name: str, inputs: int, options: argparse.Namespace) -> Counter[str]:
    """Counts of one reader."""
    counts: Counter[str] = Counter()
    done, context = 0, multiprocessing.get_context("fork")
    while done < inputs:
        with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
            progress = context.Array("q", 5, lock=False)  # done, read, refused, findings, longest us
            process = context.Process(target=work, args=(name, done, inputs, folder, options, progress))
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
                kept(options, f"{name} {done}", b"", f"the process ended with {process.exitcode}")
                counts["findings"] += 1
                done += 1
    return counts


def work(name: str, first: int, last: int, folder: str, options: argparse.Namespace, progress: Any) -> None:
    """Read mutated files one after another; the damaged one is on disk when it is read."""
    from readers import DOCUMENTED, READERS, mutated, write_sound_files

    def alarmed(*_: Any) -> None:
        raise TooLong

    faulthandler.enable()
    signal.signal(signal.SIGPROF, alarmed)
    warnings.simplefilter("ignore")
    reader = next(reader for reader in READERS if reader.name == name)
    root = write_sound_files(Path(folder))
    path = root / reader.file
    sound = path.read_bytes()
    reader.read(root)
    for n in range(first, last):
        path.write_bytes(mutated(random.Random(f"{name} {options.seed} {n}"), sound, reader.is_text))
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
            kept(options, f"{name} {n}", path.read_bytes(), trouble)
            progress[3] += 1
        progress[4] = max(progress[4], int(1e6 * (time.process_time() - begin)))
        progress[0] += 1
        if more > MOST_KIB:
            return


# ---- images ----

IMAGE_S = 2.0  # processor time of one file


def images(options: argparse.Namespace) -> None:
    """Damaged images of each format in one process: no file may end it."""
    from image_mutants import FORMATS, differs, mutated

    from boresight.pipeline.errors import RawDataError
    from boresight.pipeline.files.images.star_images import read_star_image

    found: Counter[str] = Counter()
    longest_s, formats = 0.0, options.only or list(FORMATS)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image"
        for kind in formats:
            rng, sound = random.Random(f"{options.seed} {kind}"), FORMATS[kind]()
            for n in range(options.count):
                content = mutated(rng.choice(sound), rng)
                path.write_bytes(content)
                begun_s, outcome = time.process_time(), "read"
                try:
                    image = read_star_image(path, "image")
                except RawDataError:
                    outcome = "refused"
                except Exception as error:
                    outcome = "error"
                    kept(options, f"{kind} {n}", content, f"{type(error).__name__}: {error}")
                longest_s = max(longest_s, time.process_time() - begun_s)
                wrong = differs(image, content) if outcome == "read" else None
                found.update([outcome] + ["compared"] * (wrong is not None) + ["differ"] * (wrong is True))
                if wrong:
                    kept(options, f"{kind} {n}", content, "other pixels than Pillow's")
    print(f"{len(formats)} formats: {', '.join(f'{n} {kind}' for kind, n in found.items())}")
    inputs = len(formats) * options.count
    judge_share("damaged images: undocumented errors", found["error"], inputs, most=0.0)
    judge_share("damaged images: pixels differ from Pillow's", found["differ"], found["compared"], most=0.0)
    judge_largest("damaged images: longest of a file", longest_s, IMAGE_S, "s CPU", inputs)


# ---- door ----


def door(options: argparse.Namespace) -> None:
    """Hostile arguments on the first strip of the example "mini"."""
    from hostile_calls import door as doors_of
    from hostile_calls import hostile_calls

    import boresight as bs

    logging.disable(logging.CRITICAL)
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        mini = bs.example("mini")
        result = bs.calibrate(mini, strips=["s01"], out=Path(folder) / "result")
        solution = bs.identify(mini / "exposures" / "e0001.png", camera=bs.open_dump(mini).star_camera)
        doors = doors_of(solution, result, mini, Path(folder))
        for one, arguments in hostile_calls(doors, options.count, options.seed):
            outcomes[called(one, arguments)] += 1
        os.chdir(ROOT)
    for name, count in outcomes.most_common():
        print(f"{count:6d} {name}")
    undocumented = sum(n for name, n in outcomes.items() if name not in ("result", "documented error"))
    judge_share("hostile calls: undocumented errors", undocumented, options.count, most=0.0)


def called(one: Any, arguments: dict[str, object]) -> str:
    """What a call comes to: an error is undocumented if docs/python.md does not list its class, if it says
    nothing, or if its text has several lines; warnings of NumPy about numbers count, too.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            one.call(**arguments)
        except one.documented as error:
            said = str(error)
            return "documented error" if said and said.isprintable() else f"{one.name}: text {said[:60]!r}"
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            return f"{one.name}: {type(error).__name__} in {Path(place.filename).name}:{place.lineno}"
    return "result"


if __name__ == "__main__":
    sys.exit(main())
