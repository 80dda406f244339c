"""What a shell offers for the values of arguments and options, after `boresight --install-completion`."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import typer

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.text_files import read_json

__all__ = ["among", "ccds_of", "first_argument", "strips_of"]


def among(words: Iterable[str], *, several: bool = False) -> Callable[[str], list[str]]:
    """Offers those of some words that continue what is typed; of `several` with commas, the last one."""
    known = tuple(words)

    def offered(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",") if several else ("", "", incomplete)
        taken = before.split(",")
        return [f"{before}{comma}{word}" for word in known if word.startswith(last) and word not in taken]

    return offered


def strips_of(context: typer.Context, incomplete: str) -> list[str]:
    """Ids of the strips of the dump: of the one that is named, that the result was made from, or into which a
    file is written. None where it is unknown.
    """
    return _continuing(incomplete, (row["id"] for row in _strips(context)))


def ccds_of(context: typer.Context, incomplete: str) -> list[str]:
    """CCDs of the strip that is named, or of all strips of the dump (`strips_of`)."""
    strip = context.params.get("strip")
    return _continuing(incomplete, (row["ccd"] for row in _strips(context) if strip in (None, row["id"])))


def first_argument(context: typer.Context, name: str) -> str | None:
    """First argument of a line; until the line is complete, arguments stand in what is left of it."""
    found = context.params.get(name) or context.args
    return str(found[0] if isinstance(found, (list, tuple)) else found) if found else None


def _continuing(incomplete: str, words: Iterable[str]) -> list[str]:
    """Those of some words that continue what is typed, each once."""
    return [word for word in dict.fromkeys(words) if word.startswith(incomplete)]


def _strips(context: typer.Context) -> list[dict[str, str]]:
    """Rows of the dump's strips.csv that have the columns id and ccd."""
    given = [context.params.get("dump"), context.params.get("result"), *context.args]
    for one in filter(None, given):
        place = Path(one).parent if Path(one).suffix == ".csv" else Path(one)
        with suppress(OSError, RawDataError, KeyError, UnicodeDecodeError, csv.Error):
            if (place / "run.json").is_file():
                place = Path(read_json(place / "run.json")["dump"])
            with (place / "strips.csv").open(newline="", encoding="utf-8") as table:
                return [row for row in csv.DictReader(table) if row.get("id") and row.get("ccd")]
    return []
