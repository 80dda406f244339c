"""What a shell offers for the values of arguments and options, after `boresight --install-completion`."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import typer

from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.text_files import read_json

__all__ = ["among", "strips_of"]


def among(words: Iterable[str], *, several: bool = False) -> Callable[[str], list[str]]:
    """Offers those of some words that continue what is typed; of `several` with commas, the last one."""
    known = tuple(words)

    def offered(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",") if several else ("", "", incomplete)
        taken = before.split(",")
        return [f"{before}{comma}{word}" for word in known if word.startswith(last) and word not in taken]

    return offered


def strips_of(context: typer.Context, incomplete: str) -> list[str]:
    """Ids of the strips of the dump, or of the dump that the result was made from; none where unknown."""
    found: dict[str, None] = {}
    places = (context.params.get("dump"), context.params.get("result"), *context.args)
    place = next((Path(one) for one in places if one), Path())
    with suppress(OSError, RawDataError, KeyError, UnicodeDecodeError, csv.Error):
        if (place / "run.json").is_file():
            place = Path(read_json(place / "run.json")["dump"])
        with (place / "strips.csv").open(newline="", encoding="utf-8") as table:
            found = dict.fromkeys(row["id"] for row in csv.DictReader(table))
    return [name for name in found if name.startswith(incomplete)]
