"""Files, settings, command line, parallel runs, reports: the only package that touches the outside world.

Importing it, before NumPy is loaded, asks the numerical libraries for one thread unless the environment says
otherwise: work is spread over processes, and sums are then rounded in the same order in all of them.
"""

import os

from boresight.version import __version__

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_name, "1")

__all__ = ["__version__"]
