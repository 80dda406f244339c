"""The command `boresight`, also as `python -m boresight`."""

import gc
import sys

__all__ = ["main"]

FEW_COLLECTIONS = 1_000_000  # what modules make stays: looking for garbage among it takes 4 % of a command


def main() -> None:
    """Run the command line; `--version` alone is answered without importing it."""
    if sys.argv[1:] == ["--version"]:
        from boresight.version import version_text

        print(version_text())
        return
    from boresight.deferred import defer

    defer("numpy.f2py", "numpy.testing", "boto3")  # SciPy and rasterio import them: 0.01 to 0.1 s each
    of_3d = (f"mpl_toolkits.mplot3d.{name}" for name in ("art3d", "axis3d", "proj3d"))
    defer("fontTools.agl", *of_3d)  # Matplotlib does, for TeX and axes in space: 0.03 s
    gc.set_threshold(FEW_COLLECTIONS)
    from boresight.pipeline.cli import main as command_line

    try:
        command_line()
    finally:
        gc.freeze()  # what is left ends with the process


if __name__ == "__main__":
    main()
