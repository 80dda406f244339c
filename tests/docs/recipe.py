"""The steps of CONTRIBUTING.md's "Add a feature": what its code blocks put into which file."""

import re

from journeys import ROOT

STEP = re.compile(r"`([\w./]+\.(?:py|md))`[^`\n]*:\n\n {4}```\w+\n(.*?)\n {4}```\n", re.DOTALL)


def recipe() -> dict[str, str]:
    """Text by file: the whole file where it is new, else the line to be added."""
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = page.partition("## Add a feature\n")[2].partition("\n## ")[0]
    indented = re.compile("^ {4}", re.MULTILINE)
    return {file: indented.sub("", block) + "\n" for file, block in STEP.findall(section)}
