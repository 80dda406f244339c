"""Stages of a run in words; their units are kept in folders of shorter names."""

from __future__ import annotations

import re

__all__ = ["stage_words"]

WORDS = (  # for folders of finished units
    (re.compile(r"\bmatching-0$"), "targets, wide search"),
    (re.compile(r"\bmatching-(\d+)$"), r"targets, round \1"),
    (re.compile(r"\bsky-stars$"), "strips of the sky"),
    (re.compile(r"\bexposures(?:-(.+))?$"), r"star exposures \1"),
)


def stage_words(stage: str) -> str:
    """A stage for the reader, who does not know the names of folders: "s1: matching-2" of dump s1, say."""
    for folder, words in WORDS:
        if folder.search(stage):
            return folder.sub(words, stage).strip()
    return stage
