"""What the demo prints has one value each in README, on pages and in recordings: that of the present code."""

import html
import re
import shutil
from pathlib import Path

import numpy as np
from command_line import ran

ROOT = Path(__file__).parents[2]
NUMBER = re.compile(r"(?<![\w.+-])[+-]?\d+\.\d+(?:e[+-]\d+)?(?![\w.])")
# Lines of `calibrate` and `validate` whose numbers do not depend on the machine beyond their last digits.
LABELS = (
    "theta, arcsec",
    "Z-X-Y angles, arcsec",
    "1 sigma, arcsec",
    "1 sigma on the ground, m",
    "chi2 / dof",
    "before, arcsec",
    "after, arcsec",
    "stated 1 sigma, arcsec",
    "after, in sigmas",
    "NEES (3 is expected)",
)
COUNTS = re.compile(r"(\d+) exposures with (\d+) stars, (\d+) strips with (\d+) targets")
# Other processors round sums in another order: matches move by 1e-5 px, the matrix by 1e-4 of its 1-sigma.
LAST_DIGITS = 3.0


def lines_of(text: str) -> list[str]:
    """Lines of a page or of a recording, without markup."""
    return [html.unescape(re.sub(r"<[^>]+>", "", line)).strip() for line in text.splitlines()]


def numbers_after(label: str, line: str) -> list[str]:
    return NUMBER.findall(line.removeprefix(label)) if line.startswith(label) else []


def test_numbers_of_the_demo_are_those_that_it_prints(demo: Path, tmp_path: Path) -> None:
    result = tmp_path / "demo-result"
    shutil.copytree(demo / "demo-result", result, ignore=shutil.ignore_patterns("work"))
    told = ran("validate", result, "--dump", ROOT / "fixtures" / "mini").output
    printed = lines_of((demo / "printed").read_text() + told)
    true = {label: next(found for one in printed if (found := numbers_after(label, one))) for label in LABELS}
    counts = next(found.groups() for one in printed if (found := COUNTS.search(one)))
    pages = [ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("docs/images/terminal-*.svg")]
    seen = dict.fromkeys(LABELS, 0)
    for page in pages:
        demo_shown = False
        for line in lines_of(page.read_text(encoding="utf-8")):
            if line.startswith("$ "):
                demo_shown = "fixtures/mini" in line
            if not demo_shown:
                continue
            for label, values in true.items():
                shown = numbers_after(label, line)
                if not shown:
                    continue
                seen[label] += 1
                step = np.array([10.0 ** -len(one.partition(".")[2]) for one in values])
                apart = np.abs(np.array(shown, dtype=float) - np.array(values, dtype=float)) / step
                assert len(shown) == len(values) and apart.max() <= LAST_DIGITS + 1e-6, f"{page.name}: {line}"
            if found := COUNTS.search(line):
                assert found.groups() == counts, f"{page.name}: {line}"
    assert min(seen.values()) >= 4, seen  # README, tutorial and two recordings
