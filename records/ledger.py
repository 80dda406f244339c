"""What became of each observation: its subject, the state it ended in, and the reason with the numbers.

Every room hands over `Entry` records: files that cannot be read, stars that fail a test, targets that are
not matched. A further reason is a row of `Reason`. Subjects are compared by equality alone; names and
sentences are made here for people, and nothing reads them.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from boresight.records.record import RowRecord, array, inner, record, scalar

if TYPE_CHECKING:  # messages and errors are there before NumPy is
    from boresight.records.record import Bools, Floats, Ints, Texts

__all__ = ["Entry", "Kind", "Ledger", "Reason", "State", "Subject", "count_words", "either_of", "list_words"]


class Kind(StrEnum):
    """What a subject is."""

    DUMP = "dump"
    HEAD = "head"
    EXPOSURE = "exposure"
    STRIP = "strip"
    CCD = "ccd"
    CHIP = "chip"
    TARGET = "target"
    STAR = "star"


@record(by_value=True)
class Subject:
    """What an entry or a finding is about; a field that does not apply is empty, or -1."""

    kind: Kind = scalar("what it is")
    strip: str = scalar("strip of the ground or of the sky", default="")
    ccd: int = scalar("CCD of the remote-sensing camera, from 0; -1: none, or all", default=-1)
    id: str = scalar("target, star or chip", default="")
    exposure: str = scalar("exposure of a star camera", default="")
    head: str = scalar("star camera", default="")
    camera: str = scalar("remote-sensing camera, where a satellite has several", default="")
    dump: str = scalar("dump, where there are several", default="")

    @property
    def name(self) -> str:
        """Its identifiers as one text, for lists: "s01/T07, CCD 2"."""
        match self.kind:
            case Kind.CCD:
                return f"{self.strip}/{self.ccd}"
            case Kind.TARGET | Kind.STAR | Kind.CHIP:
                place = f", CCD {self.ccd}" if self.ccd >= 0 else ""
                return "/".join(part for part in (self.strip or self.exposure, self.id) if part) + place
        return str(getattr(self, self.kind.value))

    @property
    def words(self) -> str:
        """What it is, in words: "CCD 2 in strip s01"; without identifiers all of the kind."""
        if self.kind is Kind.CCD:
            where = (
                f" in strip {self.strip}" if self.strip else f" of camera {self.camera}" * bool(self.camera)
            )
            return (f"CCD {self.ccd}" if self.ccd >= 0 else "all CCDs") + where
        if self.kind in (Kind.TARGET, Kind.STAR):
            return f"{self.kind.value} {self.id}" + (f" (strip {self.strip})" if self.strip else "")
        return f"{self.kind.value} {self.name}" if self.name else f"all {self.kind.value}s"

    def holds(self, other: Subject) -> bool:
        """Whether `other` is this subject or a part of it: a CCD holds the same CCD in every strip."""
        parts = ("dump", "camera", "head", "exposure", "strip", "ccd", "id")
        stated = [part for part in parts if getattr(self, part) not in ("", -1)]
        return bool(stated) and all(getattr(self, part) == getattr(other, part) for part in stated)


class State(StrEnum):
    """What became of an observation."""

    USED = "used"
    REJECTED = "rejected"
    UNMATCHED = "not matched"
    OUT_OF_VIEW = "not in view"
    UNREADABLE = "not usable"
    REPEATED = "given twice"
    NOT_NEEDED = "not needed"


class Reason(StrEnum):
    """Why an observation is in its state: words of counts and tables, the state, and the sentence that the
    numbers of an entry fill; without a sentence, the entry's own text says all.
    """

    state: State
    sentence: str
    number: int  # in the order of the rows below

    def __new__(cls, words: str, state: State, sentence: str = "") -> Reason:
        reason = str.__new__(cls, words)
        reason._value_, reason.state, reason.sentence = words, state, sentence
        reason.number = len(cls.__members__)
        return reason

    NONE = "", State.USED
    # files and tables
    UNREADABLE = "file not usable", State.UNREADABLE
    NOT_IDENTIFIED = "not identified", State.UNREADABLE
    NOT_COVERED = "not covered by orbit or star exposures", State.UNREADABLE
    NO_TARGET = "no target matched", State.UNMATCHED
    NOT_A_SKY_STRIP = "not a strip of the sky", State.UNREADABLE
    NOT_OF_THE_GROUND = "not a strip of the ground", State.UNREADABLE
    OTHER_SMEAR = "not the images that its TDI stages make", State.UNREADABLE
    NOT_CALIBRATED = "no result", State.UNREADABLE
    MARKED_INVALID = "marked invalid", State.UNREADABLE
    REPEATED = "given twice", State.REPEATED
    SAME_PIXELS = "same pixels as another", State.UNREADABLE
    SAME_TIME = "same time as another", State.UNREADABLE
    NOT_NEEDED = "not near a strip", State.NOT_NEEDED
    ATTITUDES_NOT_NEEDED = "with attitudes not near a strip", State.NOT_NEEDED
    HIDDEN = "beyond the horizon", State.UNREADABLE
    NOT_ASKED_FOR = "not asked for", State.NOT_NEEDED
    INTERNAL_ERROR = "internal error", State.UNREADABLE
    # stars of strips of the sky
    NAME_UNSURE = "name unsure", State.UNMATCHED
    NOT_ONE_STAR = "not one star in linear motion", State.UNMATCHED
    NOT_A_SHARP_STAR = "saturated or blended", State.UNMATCHED
    NOT_IN_PLACE = "not where it must be", State.UNMATCHED
    # targets
    OUT_OF_VIEW = "in no strip", State.OUT_OF_VIEW
    OUTSIDE_REACH = (
        "outside reach",
        State.OUT_OF_VIEW,
        "outside the strip for every installation matrix within the stated uncertainty",
    )
    OUTSIDE_CCDS = ("outside ccds", State.OUT_OF_VIEW, "outside every CCD's image at the common rotation")
    OUTSIDE_CHIP = (
        "outside chip",
        State.UNMATCHED,
        "coordinates lie {value:.0f} px outside its chip of {more[0]:.0f} x {more[1]:.0f} px",
    )
    CHIP_TOO_SMALL = (
        "chip too small",
        State.UNMATCHED,
        "its chip is {value:.3g} px wide in the strip, at least {limit:.0f} px are needed; check the pixel "
        "size in its geo-reference",
    )
    TOO_LITTLE_TEXTURE = (
        "too little texture",
        State.UNMATCHED,
        "its chip has too little texture: expected standard error {value:.2g} px, at most {limit} px is "
        "allowed",
    )
    NO_COMMON_ROTATION = (
        "no common rotation",
        State.UNMATCHED,
        "no common rotation: of {more[0]:.0f} targets {more[1]:.0f} agree and {more[2]:.0f} of these were "
        "matched, which happens by chance with probability {value:.1g}, {limit:.1g} is allowed",
    )
    TEMPLATE_CUT = (
        "template cut",
        State.UNMATCHED,
        "{more[0]:.0f} x {more[1]:.0f} px of its chip lie within the strip's image, {limit:.0f} are needed",
    )
    FEW_VALID_PIXELS = (
        "few valid pixels",
        State.UNMATCHED,
        "{value:.0%} of the template's pixels are valid (cloud, no data, saturation, image edge), "
        "{limit:.0%} are needed",
    )
    ONE_GREY_VALUE = (
        "one grey value",
        State.UNMATCHED,
        "the strip has the grey value {value:g} throughout its search window: the detector is dead or "
        "saturated there, or its file is empty",
    )
    NO_CORRELATION = "no correlation", State.UNMATCHED, "no positive correlation in the search window"
    NOT_CONVERGED = (
        "not converged",
        State.UNMATCHED,
        "least squares did not converge from the {more[0]:.0f} highest correlation peak(s)",
    )
    UNCERTAIN_POSITION = (
        "uncertain position",
        State.UNMATCHED,
        "standard error {value:.2g} px, at most {limit} px is allowed",
    )
    PROBABLY_WRONG = (
        "probably wrong",
        State.UNMATCHED,
        "wrong with probability {value:.1g} (highest correlation {more[0]:.2f}), at most {limit:.1g} is "
        "allowed",
    )
    AT_WINDOW_EDGE = (
        "at window edge",
        State.UNMATCHED,
        "at the edge of its search window of ±{limit:.0f} px",
    )
    SELF_SIMILAR = (
        "self similar",
        State.UNMATCHED,
        "self-similar template (correlation {more[0]:.2f} with a displaced copy of itself) with standard "
        "error {value:.2g} px, at most {limit} px is allowed to exclude a false match",
    )
    LOW_CORRELATION = (
        "low correlation",
        State.UNMATCHED,
        "correlation {value:.2f}, at least {limit} is needed",
    )
    INCONSISTENT = (
        "inconsistent",
        State.UNMATCHED,
        "{value:.1f} standard errors ({more[0]:+.2f}, {more[1]:+.2f} px) from the position that the strip's "
        "other targets predict, at most {limit:.0f} are allowed",
    )
    # the estimate
    ATTITUDE_NOT_FIXED = (
        "attitude not fixed",
        State.REJECTED,
        "{more[0]:.0f} good stars of {more[1]:.0f} do not fix the attitude",
    )
    STAR_RESIDUAL = (
        "large residual",
        State.REJECTED,
        "{sigmas:.1f} sigma from the attitude of the other {more[0]:.0f} stars (chi-square {value:.1f} for 2 "
        "degrees of freedom, limit {limit:.1f})",
    )
    TARGET_RESIDUAL = (
        "target residual",
        State.REJECTED,
        "{sigmas:.1f} sigma from the position that the other {kind}s predict (chi-square {value:.1f} for 2 "
        "degrees of freedom, limit {limit:.1f})",
    )
    NOT_BETWEEN_EXPOSURES = (
        "not covered",
        State.REJECTED,
        "its instant lies more than half a step outside the usable exposures",
    )
    NO_TARGET_COVERED = (
        "no target covered",
        State.REJECTED,
        "{more[0]:.0f} usable exposures cover none of {more[1]:.0f} targets",
    )


@record
class Entry:
    """What became of one observation; true where it is used."""

    subject: Subject = scalar("the observation")
    reason: Reason = scalar("why it is in its state", default=Reason.NONE)
    detail: str = scalar("what the reason's sentence does not say", default="")
    file: str = scalar("file concerned, or empty", default="")
    value: float = scalar("statistic of the test that failed; NaN: none", default=math.nan)
    limit: float = scalar("its limit in the unit of `value`; NaN: none", default=math.nan)
    more: tuple[float, ...] = scalar("further numbers of the sentence", default=())
    xy_px: tuple[float, ...] = scalar("(sample, line) where it was measured nevertheless", default=())
    cov_px: tuple[float, ...] = scalar("covariance of that, px²: xx, xy, yy", default=())
    rivals: tuple[Subject, ...] = scalar("of which one may be the wrong one instead", default=())
    slip: str = scalar("kind of slip in its coordinates that explains it; empty: none", default="")
    state = inner[State]("reason.state", "what became of it")

    def because(self, reason: Reason, detail: str = "") -> Entry:
        """An entry of this observation in another state."""
        return dataclasses.replace(self, reason=reason, detail=detail)

    @property
    def text(self) -> str:
        """One sentence: what was measured and what is needed, or what the file lacks."""
        numbers = {name: getattr(self, name) for name in ("value", "limit", "more")}
        sigmas = math.sqrt(self.value) if self.value >= 0.0 else math.nan
        if self.detail and math.isnan(self.value):
            return self.detail
        said = self.reason.sentence.format(sigmas=sigmas, kind=self.subject.kind.value, **numbers)
        if self.rivals:
            said += f"; it or {either_of(self.rivals)}: the data do not tell which"
        return f"{said}; {self.detail}" if said and self.detail else said or self.detail

    @property
    def line(self) -> str:
        """The subject and its text: "target s01/T07, CCD 2: correlation 0.31, at least 0.6 is needed"."""
        return f"{self.subject.kind} {self.subject.name}: {self.text}"

    @property
    def row(self) -> dict[str, str | int | float]:
        """Its columns in tables and JSON: `reason` is the sentence, `cause` what equal entries share."""
        subject = {field.name: getattr(self.subject, field.name) for field in dataclasses.fields(Subject)}
        texts = {"name": self.subject.name, "file": self.file, "reason": self.text}
        numbers = {"statistic": self.value, "limit": self.limit}
        own = {"kind": self.subject.kind.value, "cause": self.reason.value, "state": self.state.value}
        return subject | texts | own | numbers

    def __bool__(self) -> bool:
        return self.state is State.USED

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return f"{self.state}: {self.text}" if self.text else f"{self.state}"


def count_words(n: int, thing: str) -> str:
    """How many things: "1 target", "2 targets"."""
    return f"{n} {thing}{'s' if n != 1 else ''}"


def list_words(names: Sequence[str], most: int = 4) -> str:
    """Names in a sentence: "T1, T2 and 5 more"."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def either_of(subjects: Sequence[Subject]) -> str:
    """Names of subjects of which one is meant: "s01/T07 or s02/T07"."""
    return " or ".join(subject.name for subject in subjects)


@record(kw_only=True)
class Ledger(RowRecord):
    """What strips must show, targets or bright stars, and what became of it. Row n of every array is the same
    observation; sets of observations are masks.
    """

    kind: Kind = scalar("targets or stars")
    strips: tuple[str, ...] = scalar("ids of the strips")
    strip: Ints = array("N", "number of the strip in `strips`")
    ccd: Ints = array("N", "CCD of the camera, from 0")
    id: Texts = array("N", "target or star")
    part: Floats = array("N", "place on the CCD: 0 the first sample, 1 the last; NaN: not known")
    along: Floats = array("N", "place along the strip: 0 the first line, 1 the last; NaN: not known")
    magnitude: Floats = array("N", "V magnitude; NaN: not a star")
    reason: Ints = array("N", "number of the reason in `Reason`; 0: found")

    @classmethod
    def of(cls, kind: Kind, strips: Sequence[str], columns: Sequence[Any] = ((),) * 7) -> Ledger:
        """Of columns in the order above; of strips that must show nothing without any."""
        import numpy as np

        types = {"strip": int, "ccd": int, "id": str, "part": float, "along": float, "magnitude": float}
        named = zip((types | {"reason": int}).items(), columns, strict=True)
        rows: dict[str, Any] = {name: np.asarray(column, dtype=of) for (name, of), column in named}
        return cls(kind=kind, strips=tuple(strips), **rows)

    @property
    def found(self) -> Bools:
        """Which observations (N,) were found."""
        return self.reason == 0

    def is_of(self, reason: Reason) -> Bools:
        """Which observations (N,) are in their state for one reason."""
        return self.reason == reason.number

    def of_strip(self, strip_id: str) -> Ledger:
        """The rows of one strip."""
        return self.take(self.strip == self.strips.index(strip_id))

    def within(self, subjects: Iterable[Subject]) -> Bools:
        """Which observations (N,) are, or are parts of, one of some subjects."""
        inside = self.reason < 0
        for subject in subjects:
            if subject.exposure or subject.head or not (subject.strip or subject.id or subject.ccd >= 0):
                continue
            here = self.reason >= 0
            if subject.strip:
                number = self.strips.index(subject.strip) if subject.strip in self.strips else -1
                here = here & (self.strip == number)
            here = here & (self.ccd == subject.ccd) if subject.ccd >= 0 else here
            inside = inside | (here & (self.id == subject.id) if subject.id else here)
        return inside

    def subjects(self, rows: Bools) -> tuple[Subject, ...]:
        """The observations of a mask (N,)."""
        cells = zip(self.strip[rows].tolist(), self.ccd[rows].tolist(), self.id[rows].tolist())
        return tuple(Subject(self.kind, strip=self.strips[n], ccd=ccd, id=name) for n, ccd, name in cells)

    def cells(self) -> dict[tuple[str, int], tuple[int, int]]:
        """Observations found, and all, by strip and CCD."""
        every = Counter(zip(self.strip.tolist(), self.ccd.tolist()))
        found = Counter(zip(self.strip[self.found].tolist(), self.ccd[self.found].tolist()))
        return {(self.strips[n], ccd): (found[n, ccd], every[n, ccd]) for n, ccd in sorted(every)}
