"""Cameras of 12 CCDs and campaigns of 12 strips, with ids that begin alike or hold separators: what one cause
explains hides nothing else, and no code reads a name to learn what it is about.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from ledgers import ledger_of

from boresight.pipeline.diagnosis.losses import OF_STARS, displaced_ccds, lost_ccds, lost_groups
from boresight.records.ledger import Kind, Ledger, Reason, Subject

ROOT = Path(__file__).parents[3]
IDS = (
    [f"s{n}" for n in range(1, 13)],
    [f"T{n}" for n in range(1, 13)],
    ["a", "a/b", "a/b/c", "a, CCD 1", "CCD 1", "CCD 11", "strip s1", "s1", "s1/s1", "s11", ", CCD 2", "1"],
)
CCDS, STARS = 12, 16  # of a camera, and of each CCD in each strip


def campaign(names: list[str], rng: np.random.Generator, lost) -> Ledger:
    """Stars of 12 CCDs in 12 strips; `lost` says which (strip, ccd, part, magnitude) are missing."""
    strip, ccd = (axis.ravel() for axis in np.meshgrid(np.arange(12), np.arange(CCDS), indexing="ij"))
    strip, ccd = np.repeat(strip, STARS), np.repeat(ccd, STARS)
    part, magnitude = rng.uniform(size=len(ccd)), rng.uniform(3.0, 8.0, len(ccd))
    reasons = [
        Reason.NOT_IN_PLACE if gone else Reason.NONE for gone in lost(strip, ccd, part, magnitude).tolist()
    ]
    return ledger_of([names[n] for n in strip], ccd, reasons, part=part, magnitude=magnitude, kind=Kind.STAR)


def items(ledger: Ledger, explained: list[Subject]) -> list[str]:
    left = ledger.take(~ledger.within(explained))
    return [finding.item for finding in lost_groups(left, OF_STARS)]


@pytest.mark.parametrize("names", IDS, ids=["strips", "targets", "separators"])
@pytest.mark.parametrize("seed", range(2))
def test_an_explained_subject_hides_only_losses_within_it(names: list[str], seed: int) -> None:
    rng = np.random.default_rng(seed)
    (half, other_ccd), (faint, other_strip) = (rng.permutation(12)[:2] for _ in range(2))
    ledger = campaign(
        names, rng, lambda s, c, part, v: ((c == half) & (part < 0.45)) | ((s == faint) & (v > 5.8))
    )
    expected = {f"first half of CCD {half}", f"strip {names[faint]}, fainter than V"}
    for explained in (
        [],
        [Subject(Kind.CCD, ccd=int(other_ccd))],
        [Subject(Kind.STRIP, strip=names[other_strip])],
        [Subject(Kind.CCD, ccd=int(other_ccd)), Subject(Kind.STRIP, strip=names[other_strip])],
        [Subject(Kind.CCD, strip=names[other_strip], ccd=int(half))],
    ):
        told = {re.sub(r" V [\d.]+$", " V", item) for item in items(ledger, explained)}
        assert expected <= told, (explained, told)
    within = [Subject(Kind.CCD, ccd=int(half)), Subject(Kind.STRIP, strip=names[faint])]
    assert items(ledger, within) == []


@pytest.mark.parametrize("names", IDS, ids=["strips", "targets", "separators"])
def test_ccds_one_and_eleven_are_two(names: list[str]) -> None:
    rng = np.random.default_rng(3)
    ledger = campaign(names, rng, lambda s, c, part, v: np.isin(c, (1, 11)))
    assert lost_ccds(ledger, OF_STARS) == [1, 11]
    left = ledger.take(~ledger.within([Subject(Kind.CCD, ccd=1)]))
    assert lost_ccds(left, OF_STARS) == [11]
    told = displaced_ccds([11], left, "stars", refutes=False)
    assert {(subject.strip, subject.ccd) for subject in told.explains} == {(name, 11) for name in names}


def test_subjects_whose_names_are_alike_are_not_equal() -> None:
    """The names of lists are for people: two subjects may share one."""
    one = Subject(Kind.TARGET, strip="a", id="b/c")
    other = Subject(Kind.TARGET, strip="a/b", id="c")
    assert one.name == other.name and one != other and not one.holds(other)
    ccd = Subject(Kind.CCD, ccd=1)
    assert ccd.holds(Subject(Kind.STAR, strip="s1", ccd=1, id="HIP 1"))
    assert not ccd.holds(Subject(Kind.STAR, strip="s1", ccd=11, id="HIP 1"))
    assert not Subject(Kind.STRIP, strip="s1").holds(Subject(Kind.CCD, strip="s12", ccd=1))


# Ways to read a name: a part of it, a pattern, a beginning; and texts that a program wrote.
PARSERS = re.compile(
    r"\.r?partition\(|\bre\.\w+\(|\bin \w+\.(?:item|name|text)\b|\.(?:item|name|text)\.(?:starts|ends)with"
    r'|\.replace\("_", " "\)|removeprefix\(f?"'
)
# Lines that read no subject: names of this program's own files, stages and limits, of unknowns in saved
# tables, identifiers within drawings, and the kind of an error, which its cause begins with.
ALLOWED = {
    "pipeline/run/stage_words.py": ("re.compile",),
    "pipeline/results/limits.py": ("min-",),
    "pipeline/results/ownership.py": ("re.compile",),
    "pipeline/results/reading.py": ("ALIGNMENT", "DISTORTION", "target/"),
    "pipeline/results/summary.py": ('cause.partition(",")',),
    "pipeline/report/saved.py": ('table.rpartition("/")', 'column.partition(".")'),
}


def test_no_code_reads_names_to_learn_what_they_are_about() -> None:
    found = []
    for room in ("diagnosis", "calibration", "stages", "results", "report"):
        for path in sorted((ROOT / "pipeline" / room).rglob("*.py")):
            file = path.relative_to(ROOT).as_posix()
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
                if PARSERS.search(line) and not any(word in line for word in ALLOWED.get(file, ())):
                    found.append(f"{file}:{number}: {line.strip()}")
    assert found == [], "\n".join(found)
