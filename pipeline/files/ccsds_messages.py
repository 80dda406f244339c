"""Read the blocks of CCSDS messages (OEM 502.0-B, AEM and ACM 504.0-B), KEYWORD = value form (KVN) or XML.

A message is a header and blocks of keywords and rows. A row is a time and numbers: in KVN a line, in XML a
line, too, or an element with an element for each.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from xml.etree.ElementTree import Element

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import check_extent
from boresight.pipeline.files.xml_files import elements_of, xml_root
from boresight.records.record import record, scalar

__all__ = ["Block", "MessageKind", "message_blocks"]

HEADER, OUTSIDE = "header", ""  # names of what stands before the first block, and between blocks
MAX_SEGMENTS = 10_000  # of a message: far more than an operator's has
MAX_LINES = 2**20  # of a message in KVN; a row takes 0.5 kB
# Units of the elements of a row in CCSDS 505.0-B, by their names; values in others are refused.
UNITS = dict.fromkeys("XYZ", "km") | dict.fromkeys(("X_DOT", "Y_DOT", "Z_DOT"), "km/s")
UNITS |= dict.fromkeys(("ANGLE_1", "ANGLE_2", "ANGLE_3"), "deg")


@record(kw_only=True)
class MessageKind:
    """What is expected of one kind of message."""

    name: str = scalar("its name, such as OEM")
    versions: tuple[str, ...] = scalar("values of CCSDS_NAME_VERS that are read")
    standard: str = scalar("which describes it")
    required: Mapping[str, tuple[str, ...]] = scalar("keywords that a block must have, by its name")
    optional: Mapping[str, tuple[str, ...]] = scalar(
        "all others that it may have, by its name; any where none are listed", default_factory=dict
    )
    rows: Mapping[str, tuple[str, str]] = scalar(
        "blocks that have rows; in XML the element that holds them (none: the segment), and that of a row"
    )
    unused: tuple[str, ...] = scalar("names of blocks that are not read", default=())

    @property
    def mark(self) -> str:
        """The first keyword of a message."""
        return f"CCSDS_{self.name}_VERS"

    @property
    def blocks(self) -> tuple[str, ...]:
        """Names before _START and _STOP."""
        return tuple(name for name in ("META", *self.rows, *self.unused) if name != OUTSIDE)


@record(kw_only=True)
class Block:
    """Keywords and rows of one block."""

    name: str = scalar("META, or another name before _START and _STOP; OUTSIDE of these: empty")
    begin: str = scalar('what errors put before a missing keyword: "META_START of line 5, ", "segment 2, "')
    values: dict[str, str] = scalar("by keyword")
    fields: dict[str, str] = scalar('keywords as errors name them: "line 9, REF_FRAME"')
    row: str = scalar('what errors call a row, "line"', default="line")
    numbers: Sequence[int] = scalar("of the rows", default=())
    rows: Sequence[str | Element] = scalar("as they are", default=())

    def error(self, key: str, found: str, expected: str, file: str) -> RawDataError:
        """The error about a keyword."""
        return RawDataError(file, self.fields.get(key, self.begin + key), found, expected)

    def at(self, n: int) -> str:
        """Row n as errors name it: "line 12", "state 3"."""
        return f"{self.row} {self.numbers[n]}"

    def lines(self, names: Sequence[str], file: str) -> list[str]:
        """The rows as lines: of an element its EPOCH and the values of `names`."""
        return [
            row if isinstance(row, str) else _line(row, ("EPOCH", *names), file, self.at(n))
            for n, row in enumerate(self.rows)
        ]


def message_blocks(text: str, file: str, *kinds: MessageKind) -> tuple[MessageKind, list[Block]]:
    """The kind of a message, which must be one of `kinds`, and its header and blocks, in their order.

    `RawDataError` for another message or version, blocks that are not closed, lines that are no KEYWORD =
    value, and keywords that are missing, unknown or there twice.
    """
    if text.lstrip().startswith("<"):
        root = xml_root(text.lstrip(), file)  # well-formed, without DTD
        kind, message = _message(root, kinds, file)
        blocks = list(_xml_blocks(message, kind, file))
    else:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
        check_extent(file, "text", (text.count("\n"),), MAX_LINES, "lines")
        rows = [(number, given.strip()) for number, given in enumerate(text.split("\n"), start=1)]
        rows = [(number, line) for number, line in rows if line and not line.startswith("COMMENT")]
        number, first = rows[0] if rows else (1, "nothing")
        of_first = [one for one in kinds if first.startswith(one.mark)]
        if not of_first:
            marks, names = (" or ".join(part) for part in zip(*((one.mark, one.name) for one in kinds)))
            raise RawDataError(file, f"line {number}", first[:64], f"{marks} = ..., or {names} in XML")
        kind, blocks = of_first[0], list(_kvn_blocks(rows, of_first[0], file))
    check_extent(file, "META", (sum(block.name == "META" for block in blocks),), MAX_SEGMENTS, "blocks")
    if (version := blocks[0].values.get(kind.mark, "nothing")) not in kind.versions:
        raise blocks[0].error(kind.mark, version, ", ".join(kind.versions), file)
    return kind, blocks


def _kvn_blocks(rows: list[tuple[int, str]], kind: MessageKind, file: str) -> Iterator[Block]:
    """Blocks of lines with their numbers."""
    edges = [n for n, (_, line) in enumerate(rows) if line.endswith(("_START", "_STOP"))]
    name, begin, first, known = HEADER, "", 0, kind.blocks
    for n in edges:
        number, line = rows[n]
        other, _, edge = line.rpartition("_")
        if other not in known:
            if name in kind.unused or "=" in line:
                continue
            raise RawDataError(file, f"line {number}", line, f"blocks {', '.join(known)}")
        is_inside = name in known
        if is_inside == (edge == "START") or (is_inside and other != name):
            expected = f"{name}_STOP" if is_inside else f"{other}_START"
            raise RawDataError(file, f"line {number}", line, f"{expected} before it")
        yield _kvn_block(name, begin, rows[first:n], kind, file)
        name, begin = (other, f"{line} of line {number}, ") if edge == "START" else (OUTSIDE, "")
        first = n + 1
    if name in known:
        raise RawDataError(file, "end of the file", f"{begin}not closed", f"{name}_STOP")
    yield _kvn_block(name, begin, rows[first:], kind, file)


def _kvn_block(name: str, begin: str, rows: list[tuple[int, str]], kind: MessageKind, file: str) -> Block:
    has_rows = name in kind.rows
    pairs, numbers, lines = list[tuple[str, str, str]](), list[int](), list[str]()
    for number, line in () if name in kind.unused else rows:
        if "=" in line:
            key, _, value = line.partition("=")
            pairs.append((f"line {number}, ", key.strip(), value.strip()))
        elif has_rows:
            numbers.append(number)
            lines.append(line)
        else:
            raise RawDataError(file, f"line {number}", line, "KEYWORD = value, or a block")
    return _block(name, begin, pairs, kind, file, rows=lines, numbers=numbers)


def _message(root: Element, kinds: Sequence[MessageKind], file: str) -> tuple[MessageKind, Element]:
    """The one message of these kinds that an XML file is or holds."""
    tags = {tag: kind for kind in kinds for tag in (kind.name.lower(), f"{kind.name.lower()}Type")}
    every = [(tags[one.tag], one) for one in root.iter() if one.tag in tags]
    if len(every) != 1:
        inside = f" of {', '.join(sorted({one.tag for one in root}))}"[:64] if root.tag == "ndm" else ""
        expected = f"{' or '.join(kind.name.lower() for kind in kinds)}, or ndm with one such message"
        raise RawDataError(file, "root element", root.tag[:64] + inside, expected)
    return every[0]


def _xml_blocks(message: Element, kind: MessageKind, file: str) -> Iterator[Block]:
    """Blocks of the XML form."""
    version = ("", kind.mark, message.get("version", "").strip())
    yield _block(HEADER, "", [version, *_leaves(message.iterfind("header/*"), "")], kind, file)
    segments = elements_of(message, "body/segment", file, 1, MAX_SEGMENTS)
    for number, segment in enumerate(segments, start=1):
        inside = f"segment {number}, " if len(segments) > 1 else ""
        yield _block("META", inside, _leaves(segment.iterfind("metadata//*"), inside), kind, file)
        for name, (holder, row) in kind.rows.items():
            if not holder:
                states = tuple(segment.iterfind(f"data/{row}"))
                yield _block(name, inside, [], kind, file, rows=states, row=f"{inside}state")
            for n, one in enumerate(segment.iterfind(f"data/{holder}") if holder else (), start=1):
                begin, rows = f"{inside}{holder} {n}, ", tuple(one.iterfind(row))
                pairs = [pair for pair in _leaves(one, begin) if pair[1] != row]
                yield _block(name, begin, pairs, kind, file, rows=rows, row=f"{begin}{row}")


def _leaves(elements: Iterable[Element], inside: str) -> list[tuple[str, str, str]]:
    """Elements without others inside as keywords."""
    leaves = [one for one in elements if not len(one) and one.tag != "COMMENT"]
    return [(inside, one.tag, (one.text or "").strip()) for one in leaves]


def _block(
    name: str,
    begin: str,
    pairs: Iterable[tuple[str, str, str]],
    kind: MessageKind,
    file: str,
    *,
    rows: Sequence[str | Element] = (),
    numbers: Sequence[int] | None = None,
    row: str = "line",
) -> Block:
    """A block of checked keywords: what errors put before each, the keyword and its value."""
    values, fields = dict[str, str](), dict[str, str]()
    required, optional = kind.required.get(name, ()), kind.optional.get(name)
    for where, key, value in pairs:
        if optional is not None and key not in required + optional:
            raise RawDataError(file, where + key, "an unknown keyword", f"one of {kind.standard}")
        if key in values:
            raise RawDataError(file, where + key, "a second time", "each keyword once")
        values[key], fields[key] = value, where + key
    found = range(1, len(rows) + 1) if numbers is None else numbers
    block = Block(name=name, begin=begin, values=values, fields=fields, row=row, numbers=found, rows=rows)
    for key in required:
        if not values.get(key):
            raise block.error(key, "nothing", f"this keyword of {kind.standard}", file)
    return block


def _line(row: Element, names: Sequence[str], file: str, where: str) -> str:
    """The text of a row, or of its elements, in the order of `names`."""
    if not len(row):
        return (row.text or "").strip()
    words = defaultdict[str, list[str]](list)
    for one in row.iter():
        words[one.tag] += (one.text or "").split()
        if (unit := one.get("units", "").lower()) and unit != UNITS.get(one.tag, unit):
            raise RawDataError(file, f"{where}, {one.tag}", f"units {unit}", UNITS[one.tag])
    for name in names:
        if len(words[name]) != 1:
            raise RawDataError(file, f"{where}, {name}", " ".join(words[name]) or "nothing", "one value")
    return " ".join(words[name][0] for name in names)
