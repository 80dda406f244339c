"""The command `boresight`, also as `python -m boresight`."""

import gc
import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line; `--version` alone is answered without importing it."""
    if sys.argv[1:] == ["--version"]:
        from boresight.version import version_text

        print(version_text())
        return
    gc.set_threshold(100_000)  # what modules make stays: looking for garbage among it takes 4 % of a command
    from boresight.pipeline.cli import main as command_line

    command_line()


if __name__ == "__main__":
    main()
