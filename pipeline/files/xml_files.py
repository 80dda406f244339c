"""Read values out of an operator's XML metadata; errors name file, element, found and expected.

A text is parsed without DTD, entities or references, and every number is checked. Names of elements lose
their namespaces.
"""

from __future__ import annotations

import codecs
import re
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
import numpy as np
from defusedxml.common import DefusedXmlException

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.content import check_extent, limited_content
from boresight.pipeline.files.text_files import MAX_TEXT_BYTES, NUMBER, unpacked, utf8_text

__all__ = ["elements_of", "numbers_of", "read_xml", "text_of", "whole_of", "xml_of_bytes", "xml_root"]

# Most tags and attributes of a document: one takes some 200 bytes of memory.
MAX_TAGS = 2**22
# The declaration of an XML file that names its encoding.
_ENCODING = re.compile(rb"""\s*<\?xml[^>]{0,200}?\sencoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")


def read_xml(path: Path, file: str) -> Element:
    """The root of an XML file, plain or compressed with gzip; `RawDataError` for anything else, or a DTD."""
    raw = limited_content(path, file, "a readable file", MAX_TEXT_BYTES)
    return xml_of_bytes(unpacked(raw, file, MAX_TEXT_BYTES), file)


def xml_of_bytes(raw: bytes, file: str) -> Element:
    """The root of XML in UTF-8, UTF-16 with a mark, or the stated encoding; otherwise as `xml_root`."""
    stated = _ENCODING.match(raw)
    is_other = stated is not None and stated[1].upper() not in (b"UTF-8", b"UTF8")
    is_other |= raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return xml_root(raw if is_other else utf8_text(raw, file), file)


def xml_root(text: str | bytes, file: str) -> Element:
    """The root element of XML text; `RawDataError` for anything else, and for a DTD."""
    marks = "<=" if isinstance(text, str) else (b"<", b"=")
    check_extent(file, "XML", (sum(map(text.count, marks)),), MAX_TAGS, "tags and attributes")  # type: ignore
    try:
        root = defusedxml.ElementTree.fromstring(text, forbid_dtd=True)
    except DefusedXmlException as error:
        expected = "XML without DTD, entities or references"
        raise RawDataError(file, "XML", type(error).__name__, expected) from error
    except (ParseError, ValueError, LookupError) as error:  # LookupError: an encoding of no known name
        raise RawDataError(file, "XML", str(error), "well-formed XML") from error
    assert isinstance(root, Element)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    return root


def elements_of(root: Element, where: str, file: str, least: int, most: int) -> list[Element]:
    """All elements at a path; `RawDataError` unless there are `least` to `most`."""
    found = root.findall(where)
    if not least <= len(found) <= most:
        raise RawDataError(file, where, f"{len(found)} elements", f"{least} to {most} elements")
    return found


def text_of(root: Element, where: str, file: str) -> str:
    """The text of the one element at a path; `RawDataError` for none, several or an empty one."""
    found = root.findall(where)
    if len(found) != 1 or not (found[0].text or "").strip():
        elements = f"{len(found)} such elements, or an empty one"
        raise RawDataError(file, where, elements, "one element with text")
    return (found[0].text or "").strip()


def numbers_of(root: Element, where: str, file: str, number: int) -> list[float]:
    """The finite numbers of the one element at a path; `RawDataError` for other text."""
    words = text_of(root, where, file).split()
    expected = f"{number} finite number{'s' if number > 1 else ''}"
    if len(words) != number:
        raise RawDataError(file, where, f"{len(words)} words", expected)
    if wrong := [word for word in words if not re.fullmatch(NUMBER, word) or not np.isfinite(float(word))]:
        raise RawDataError(file, where, wrong[0], expected)
    return [float(word) for word in words]


def whole_of(root: Element, where: str, file: str, largest: int) -> int:
    """The whole number, 0 to `largest`, of the one element at a path; `RawDataError` otherwise."""
    text = text_of(root, where, file)
    if not re.fullmatch(r"[0-9]{1,10}", text) or int(text) > largest:
        raise RawDataError(file, where, text, f"a whole number from 0 to {largest}")
    return int(text)
