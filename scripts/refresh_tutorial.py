"""Put the true output of the commands of docs/tutorial.md and docs/first-year.md behind them, and of the two
on README's first screen: `python scripts/refresh_tutorial.py`.

A block that follows `<!-- run -->` is run in a fresh folder beside a link to `fixtures`: console blocks
command by command (`$ cat NAME` makes the file from what stands there), Python blocks as one script.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import tempfile
from dataclasses import dataclass
from pathlib import Path

from typer.testing import CliRunner

from boresight.console import command_line

ROOT = Path(__file__).parents[1]
TUTORIAL = ROOT / "docs" / "tutorial.md"
FIRST_YEAR = ROOT / "docs" / "first-year.md"
README = ROOT / "README.md"
FIRST_SCREEN = re.compile(r"(\n\$ boresight calibrate fixtures/mini.*?)(?=```)", re.DOTALL)
BLOCK = re.compile(r"<!-- run -->\n```(console|python)\n(.*?)```\n(?:\n```text\n(.*?)```\n)?", re.DOTALL)


@dataclass(frozen=True)
class Step:
    """One command and what it is shown to print."""

    command: str
    shown: str


def steps(kind: str, text: str, shown: str) -> list[Step]:
    """The commands of a block. Of a Python block the output stands in a block of its own behind it."""
    if kind == "python":
        return [Step(text, shown)]
    parts = re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]
    return [Step(*part.split("\n", 1)) if "\n" in part else Step(part, "") for part in parts]


def run(kind: str, step: Step) -> str:
    """What a step prints to standard output, run in the present folder. `RuntimeError` when it fails; what a
    result is said to be by an exit status of 3 or more is no failure.
    """
    if kind == "python":
        with contextlib.redirect_stdout(io.StringIO()) as out:
            exec(step.command, {})
        return out.getvalue()
    name, *arguments = shlex.split(step.command)
    if name == "cat":
        Path(arguments[0]).write_text(step.shown)
        return step.shown
    done = CliRunner().invoke(command_line(), arguments)
    if done.exit_code in (1, 2):
        raise RuntimeError(f"{step.command}\n{done.output}") from done.exception
    return done.stdout


def prepared(folder: Path) -> Path:
    """A folder in which the tutorial's paths mean what they say."""
    (folder / "fixtures").symlink_to(ROOT / "fixtures")
    return folder


def refreshed(text: str) -> str:
    """The tutorial with all output made anew."""

    def renewed(match: re.Match[str]) -> str:
        kind, block, shown = match[1], match[2], match[3] or ""
        outputs = [(step, run(kind, step)) for step in steps(kind, block, shown)]
        if kind == "python":
            return f"<!-- run -->\n```python\n{block}```\n\n```text\n{outputs[0][1]}```\n"
        body = "".join(f"$ {step.command}\n{output}" for step, output in outputs)
        return f"<!-- run -->\n```console\n{body}```\n"

    return BLOCK.sub(renewed, text)


def first_screen(tutorial: str) -> str:
    """Commands and output of README's first screen, as they stand in the tutorial."""
    blocks = [match[2] for match in BLOCK.finditer(tutorial)]
    wanted = [f"boresight {name} " for name in ("calibrate", "validate")]
    return "\n" + "".join(next(block for block in blocks if name in block) for name in wanted)


def main() -> None:
    for page in (FIRST_YEAR, TUTORIAL):
        with tempfile.TemporaryDirectory() as name:
            with contextlib.chdir(prepared(Path(name))):
                text = refreshed(page.read_text())
            page.write_text(text)
    README.write_text(FIRST_SCREEN.sub(lambda m: first_screen(text), README.read_text(), count=1))


if __name__ == "__main__":
    main()
