"""Phrases that plain technical English replaces, where they still occur: `python scripts/plain_words.py`.

Exit status 1 if any occurs in the tracked Python, Markdown, HTML or TOML files.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Phrase, in lower case: what to write instead.
INSTEAD = {
    r"speaks? of the same": "refers to",
    r"(?:is|are) lent": "regularised with",
    r"never bridged": "interpolation across a data gap raises OrbitGapError",
    r"(?:its|own) fold\b|that fold\b": "turning point of the distortion polynomial",
    r"beyond doubt": "say which test",
    r"\bskirts?\b": "wings",
    r"\bbelie(?:f|fs|ve|ves|ved|ving)\b": "prior, hypothesis, assumed",
    r"\bvoiceless\b": "n_excluded",
    r"still on their way": "not yet converged",
    r"\btelling\b": "is_informative",
    r"\bdrowns?\b": "below the rounding error",
    r"how far it goes": "convergence limits",
    r"\b(?:targets_)?taken_apart\b|taken apart": "treated as independent",
    r"down_to_the_noise|most_shared_matrix": "refine_geman_mcclure, l1_start",
    r"can be believed": "accepted",
    r"things alike": "self-similar",
    r"leans? one way|leaning structures": "illumination-dependent bias",
    r"normalised_residuals": "squared_mahalanobis",
    r"misfortune": "a failed unit does not abort the run",
    r"that anybody has to be told": "not reported",
    r"could not be worked on": "internal error in <stage>",
    r"ground's matrix|matrix measured on the ground": "pre-launch installation matrix",
    r"unit matrix": "until the correction vanishes",
    r"look-?alikes?": "false match",
    r"\bboost(?:ed|s)?\b": "aberrate",
    r"\bplacings?\b": "position, measurement",
    r"\bguess(?:es|ed)?\b": "hypothesis",
    r"(?<!\bin )\b(?:small |a )?turns? about": "rotation about",
    r"\bturned by\b": "rotated by",
    r"\bbent\b": "distorted, deflected",
    r"\bnobody\b|\banybody\b|\bmisled\b": "say what happens",
    r"\bto be told\b|\bis told\b|\bare told\b|\btold of\b": "reported, progress callback",
    r"worth a search": "is informative",
}
FILES = ("*.py", "*.md", "*.j2", "*.toml", "*.js")
EXEMPT = ("scripts/plain_words.py", "CHANGELOG.md", "benchmarks/results/", "fixtures/")


def occurrences() -> list[str]:
    """Every occurrence as "file:line: phrase -> replacement"."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", *FILES],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    found = []
    for name in listed.stdout.split("\n"):
        path = ROOT / name
        if not name or name.startswith(EXEMPT) or path.is_symlink() or not path.is_file():
            continue
        text = path.read_text(encoding="utf-8").lower()  # searched faster than with re.IGNORECASE
        for phrase, instead in INSTEAD.items():
            for match in re.finditer(phrase, text):
                number = text.count("\n", 0, match.start()) + 1
                found.append(f"{name}:{number}: {match[0]!r} -> {instead}")
    return found


if __name__ == "__main__":
    found = occurrences()
    print("\n".join(found))
    print(f"{len(found)} occurrences")
    sys.exit(bool(found))
