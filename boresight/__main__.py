"""The command `boresight`, also as `python -m boresight`."""

import gc
import os
import sys

from boresight.version import version_text

__all__ = ["main"]

FEW_COLLECTIONS = 1_000_000  # what modules make stays: looking for garbage among it takes 4 % of a command


def main() -> None:
    """Run the command line; `--version` alone is answered without importing it."""
    _open_streams()
    if sys.argv[1:] == ["--version"]:
        print(version_text())
        return
    gc.set_threshold(FEW_COLLECTIONS)
    from boresight.console import run_command_line

    try:
        run_command_line()
    finally:
        gc.freeze()  # what is left ends with the process


def _open_streams() -> None:
    """Standard streams that the caller closed lead nowhere; files would otherwise get their numbers."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            stream = open(os.devnull, "r" if name == "stdin" else "w")
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)


if __name__ == "__main__":
    main()
