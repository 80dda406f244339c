"""The picture of docs/notes/star-half.md of planned fields, by the command that the page shows:
`python scripts/figures/star_camera_plan.py [FOLDER]`.
"""

from __future__ import annotations

import re
from pathlib import Path

from style import IMAGES

from boresight.console import command_line

PAGE = Path(__file__).parents[2] / "docs" / "notes" / "star-half.md"


def main() -> None:
    found = re.search(r"\$ boresight (star-camera-plan --size .*)", PAGE.read_text(encoding="utf-8"))
    assert found is not None
    plot = IMAGES / "star_camera_plan.png"
    command_line()([*found[1].split(), "--plot", str(plot)], standalone_mode=False)


if __name__ == "__main__":
    main()
