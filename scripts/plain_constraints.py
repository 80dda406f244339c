"""Write constraints-plain.txt: the pins of constraints.txt without hashes.

`pip install -c constraints.txt WHEEL` fails, because hashes are then wanted of the wheel, too:

    python scripts/plain_constraints.py
    pip install -c constraints-plain.txt boresight
"""

from __future__ import annotations

import re
from pathlib import Path

__all__ = ["plain_constraints"]

ROOT = Path(__file__).parents[1]


def plain_constraints(hashed: str) -> str:
    """The pins of a lock with hashes, one a line, with their markers."""
    pins = re.findall(r"(?m)^([\w.\-]+==.*?) \\$", hashed)
    return "".join(f"{pin}\n" for pin in ["# constraints.txt without hashes: make lock", *pins])


if __name__ == "__main__":
    text = plain_constraints((ROOT / "constraints.txt").read_text(encoding="utf-8"))
    (ROOT / "constraints-plain.txt").write_text(text, encoding="utf-8")
