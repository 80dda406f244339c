"""Recordings of the terminal as animated SVG: `python scripts/figures/terminal.py [NAME...]`.

What a command prints into a pipe of 80 columns (progress is a line a tenth there), and into one of 200 for
the file with that number in its name, appears at the times at which it was printed, at most `LONGEST_WAIT_S`
apart. A line that is wider is an error. A reader who prefers no motion, or a printer, sees the last frame.
"""

from __future__ import annotations

import html
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
COLUMNS = {"": 80, "-200": 200}  # by the end of the file's name
LINE_PX, CHAR_PX, PAD_PX = 19, 8.4, 14
LONGEST_WAIT_S, TYPING_S = 0.6, 0.7
RECORDINGS = {
    "terminal-calibrate": (
        "boresight calibrate fixtures/mini --out demo-result",
        "boresight report demo-result --require-arcsec 1",
    ),
    "terminal-validate": (
        "boresight calibrate fixtures/mini --out demo-result --quiet",
        "boresight validate demo-result --dump fixtures/mini --max-ground-m 6",
        "boresight validate demo-result --dump fixtures/mini --max-ground-m 2; echo $?",
    ),
}


@dataclass(frozen=True)
class Line:
    """One line of the recording."""

    at_s: float
    text: str
    typed: bool


def recorded(commands: tuple[str, ...], folder: Path, columns: int) -> list[Line]:
    """Lines of the terminal with the times at which they appear. `ValueError` for one that is too wide."""
    (folder / "fixtures").symlink_to(ROOT / "fixtures")
    now_s, lines = 0.4, []
    for command in commands:
        lines.append(Line(now_s, f"$ {command}", True))
        now_s += TYPING_S
        for wait_s, text in output(command, folder, columns):
            now_s += min(wait_s, LONGEST_WAIT_S)
            lines.append(Line(now_s, text, False))
    if wide := [line.text for line in lines if len(line.text) > columns]:
        raise ValueError(f"wider than {columns} columns: {wide}")
    return lines


def output(command: str, folder: Path, columns: int) -> list[tuple[float, str]]:
    """Lines that a command prints, each with the seconds since the one before."""
    known = {"COLUMNS": str(columns), "NO_COLOR": "1", "PYTHONUNBUFFERED": "1"}
    shell = command.replace("boresight ", f"{sys.executable} -m boresight ", 1)
    parts, last = [], time.perf_counter()
    with subprocess.Popen(
        shell,
        shell=True,
        cwd=folder,
        env=os.environ | known,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            now = time.perf_counter()
            parts.append((now - last, line.rstrip()))
            last = now
    return parts


def svg(lines: list[Line], columns: int) -> str:
    """The lines as an animated SVG in the colours of the reader's scheme."""
    width = 2 * PAD_PX + CHAR_PX * columns
    height = 2 * PAD_PX + LINE_PX * len(lines)
    rows = "".join(
        f'<text x="{PAD_PX}" y="{PAD_PX + LINE_PX * (n + 0.75):.1f}"'
        f' class="{"typed" if line.typed else "said"}" style="animation-delay:{line.at_s:.2f}s"'
        f' xml:space="preserve">{html.escape(line.text)}</text>\n'
        for n, line in enumerate(lines)
    )
    title = f"Recording of a terminal: {'; '.join(line.text[2:] for line in lines if line.typed)}"
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" role="img">
<title>{html.escape(title)}</title>
<style>
svg {{ font: 14px ui-monospace, "DejaVu Sans Mono", Menlo, monospace; }}
rect {{ fill: #f6f6f2; stroke: #d5d5cf; }} text {{ fill: #1b1d20; }}
.typed {{ fill: #0b5394; font-weight: 600; }}
@media (prefers-color-scheme: dark) {{
rect {{ fill: #14171a; stroke: #33393f; }} text {{ fill: #e6e7e4; }} .typed {{ fill: #8cbdf0; }} }}
@media screen and (prefers-reduced-motion: no-preference) {{
text {{ animation: show 0.01s backwards; }} @keyframes show {{ from {{ visibility: hidden; }} }} }}
</style>
<rect x="0.5" y="0.5" width="{width - 1:.0f}" height="{height - 1:.0f}" rx="6"></rect>
{rows}</svg>
"""


def main() -> None:
    for name in sys.argv[1:] or RECORDINGS:
        for end, columns in COLUMNS.items():
            with tempfile.TemporaryDirectory() as folder:
                lines = recorded(RECORDINGS[name], Path(folder), columns)
            (IMAGES / f"{name}{end}.svg").write_text(svg(lines, columns), encoding="utf-8")
            print(f"{name}{end}: {len(lines)} lines, {lines[-1].at_s:.1f} s")


if __name__ == "__main__":
    main()
