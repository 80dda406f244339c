"""Files, settings, command line, parallel runs and reports: the only package that touches the outside
world.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("boresight")
except PackageNotFoundError:  # used from a source tree that was not installed
    __version__ = "0+source"

__all__ = ["__version__"]
