"""Benchmark records and the code that they are of: `python scripts/records.py` lists those of other code.

    python scripts/records.py                                   # stale ones, exit status 1 if there are any
    python scripts/records.py --all
    python scripts/records.py --why star_naming                 # the modules that differ from its commit's
    python scripts/records.py --run star_naming speed --with OLDER=../old MISSION=build/mission
    python scripts/records.py --stamp real_exports              # a record without the line "code"

A record states the commit, the digest of the code that it depends on (`benchmarks/code_digest.py`) and its
command. It is stale where that digest is not that of the present code. `--run` runs the commands of chosen
records one after another; the output replaces the record. What a command names in capitals (another checkout,
a folder of dumps) is given by `--with`. Records that join several runs are not run here: their commands are
shown.
`--stamp` writes the digest of the commit that a record names into it.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RECORDS = ROOT / "benchmarks" / "results"
sys.path.insert(0, str(ROOT / "benchmarks"))
from code_digest import Commit, WorkingTree, code_of  # noqa: E402

CODE = re.compile(r"\bcode +([0-9a-f]{16}), \d+ modules")
COMMIT = re.compile(
    r"^commit +(?:boresight \S+ \(commit )?([0-9a-f]{7,40}).*$|\b[Cc]ommit ([0-9a-f]{7,40})\b", re.MULTILINE
)
COMMAND = re.compile(
    r"(?:^command +|^ {4}(?:nice -n \d+ )?|command: |`)"
    r"((?:python benchmarks/\w+\.py|boresight (?:experiment|calibrate))\b[^\n`]*?)(?:[;`].*)?$",
    re.MULTILINE,
)
ASKED = re.compile(r"\b[A-Z]{4,}\b")  # a place that differs from machine to machine: OLDER, FOLDER
WITHOUT_CODE = ("mutants", "mutants_drawn")  # quote the lines of the whole package that they break


@dataclass(frozen=True)
class BenchmarkRecord:
    """A file of `benchmarks/results` and what its head says."""

    path: Path
    text: str

    @property
    def name(self) -> str:
        """The file's name without its ending."""
        return self.path.stem

    @property
    def commands(self) -> list[str]:
        """The commands it was made by, without what continues a line of a shell."""
        joined = re.sub(r" *\\\n *", " ", self.text)
        return list(dict.fromkeys(one.rstrip(" `") for one in COMMAND.findall(joined)))

    @property
    def commit(self) -> str:
        """The first commit that it names; "" if none."""
        found = COMMIT.search(self.text)
        return next(filter(None, found.groups()), "") if found else ""

    @property
    def code(self) -> str:
        """The digest that it states; "" if none."""
        found = CODE.search(self.text)
        return found[1] if found else ""

    def state(self, tree: WorkingTree) -> str:
        """ "present", or what is not so in words."""
        if not self.code:
            return "states no digest of its code"
        now = code_of(self.commands[0], tree)
        return "present" if self.code == now.digest else f"of other code: {self.code}, now {now}"


def records(folder: Path = RECORDS) -> Iterator[BenchmarkRecord]:
    """All records that state, or should state, their code, in the order of names."""
    for path in sorted(folder.glob("*")):
        if path.suffix in (".txt", ".md") and path.stem not in WITHOUT_CODE:
            yield BenchmarkRecord(path, path.read_text(encoding="utf-8"))


def stamped(record: BenchmarkRecord, tree: WorkingTree | Commit) -> str:
    """The text of a record with the digest of its code behind the commit that it names first.

    Raises
    ------
    ValueError
        If the record names no commit or no command.
    """
    found = COMMIT.search(record.text)
    if not (found and record.commands):
        raise ValueError(f"{record.path.name} names no {'command' if found else 'commit'}")
    label, between = ("code      ", "\n") if found[1] else ("code ", ", ")
    stamp, here = f"{label}{code_of(record.commands[0], tree)}", found.end()
    if CODE.search(record.text):
        return CODE.sub(stamp, record.text, count=1)
    return f"{record.text[:here]}{between}{stamp}{record.text[here:]}"


def differing(record: BenchmarkRecord, tree: WorkingTree) -> list[str]:
    """Paths of the modules that a record depends on now, and that its commit did not have like that."""
    before = set(code_of(record.commands[0], Commit(record.commit)).modules.values())
    return [path for path, form in code_of(record.commands[0], tree).modules.items() if form not in before]


def arguments_of(record: BenchmarkRecord, given: Mapping[str, str]) -> list[str]:
    """The command of a record, as a list, with what is given for the names in capitals.

    Raises
    ------
    ValueError
        If the record has several commands or is written by hand, or a name in capitals is not given.
    """
    if len(record.commands) != 1 or record.path.suffix != ".txt":
        shown = "\n  ".join(record.commands)
        raise ValueError(f"{record.path.name} joins runs; run by hand and write it anew:\n  {shown}")
    (command,) = record.commands
    missing = sorted(set(ASKED.findall(command)) - set(given))
    if missing:
        asked = " ".join(f"{name}=..." for name in missing)
        raise ValueError(f"{record.path.name} needs --with {asked}: {command}")
    return shlex.split(ASKED.sub(lambda name: given[name[0]], command))


def run(record: BenchmarkRecord, given: Mapping[str, str]) -> None:
    """Run a record's command and put its output in the record's place; `ValueError` if it makes none."""
    words = arguments_of(record, given)
    if words[0] == "boresight":
        _run_experiment(record, words)
        return
    ran = subprocess.run([sys.executable, *words[1:]], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    if not CODE.search(ran.stdout):
        raise ValueError(f"exit status {ran.returncode}, no record from: {shlex.join(words)}")
    record.path.write_text(ran.stdout, encoding="utf-8")


def _run_experiment(record: BenchmarkRecord, words: Sequence[str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        at = words.index("--out")
        asked = [*words[1:at], "--out", folder, *words[at + 2 :]]
        subprocess.run([sys.executable, "-m", "boresight", *asked], cwd=ROOT, check=True)
        made = BenchmarkRecord(record.path, (Path(folder) / record.path.name).read_text(encoding="utf-8"))
        text = stamped(made, WorkingTree()).replace(folder, words[at + 1])
        for path in Path(folder).glob(f"{record.name}.*"):
            record.path.with_name(path.name).write_bytes(path.read_bytes())
        record.path.write_text(text, encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--all", action="store_true", help="list those of the present code, too")
    parser.add_argument("--why", metavar="NAME", help="list the modules that differ from its commit's")
    parser.add_argument("--run", nargs="+", default=[], metavar="NAME", help="records to run anew, in turn")
    parser.add_argument("--with", nargs="+", default=[], dest="given", metavar="NAME=VALUE")
    parser.add_argument("--stamp", nargs="+", default=[], metavar="NAME", help="records that shall state it")
    options = parser.parse_args()
    given = dict(pair.split("=", 1) for pair in options.given)
    known = {record.name: record for record in records()}
    asked = [*options.run, *options.stamp, *([options.why] if options.why else [])]
    if unknown := [name for name in asked if name not in known]:
        parser.error(f"no record {', '.join(unknown)} in {RECORDS.relative_to(ROOT)}")
    try:
        for name in options.stamp:
            record = known[name]
            record.path.write_text(stamped(record, Commit(record.commit)), encoding="utf-8")
        for name in options.run:
            print(f"{name}: {' '.join(arguments_of(known[name], given))}", flush=True)
            run(known[name], given)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    tree, n_stale = WorkingTree(), 0
    if options.why:
        print(*differing(known[options.why], tree), sep="\n")
        return 0
    chosen = {*options.run, *options.stamp} or set(known)
    for record in records():
        if record.name in chosen:
            state = record.state(tree)
            n_stale += state != "present"
            if options.all or options.run or options.stamp or state != "present":
                print(f"{record.name:24} {record.commit:14} {state}")
    print(f"{n_stale} of {len(chosen)} records are not of the present code")
    return int(n_stale > 0)


if __name__ == "__main__":
    sys.exit(main())
