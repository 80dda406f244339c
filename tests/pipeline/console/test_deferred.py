"""Modules that the command line does not load until they are used."""

from __future__ import annotations

import subprocess
import sys

CHECK = """
import sys
from boresight.deferred import defer
defer("numpy.f2py", "wsgiref", "no_such_module")
import numpy, scipy.spatial, wsgiref
assert "numpy.f2py.crackfortran" not in sys.modules
assert callable(numpy.f2py.run_main) and "numpy.f2py.crackfortran" in sys.modules
import wsgiref.util
assert wsgiref.__file__.endswith("__init__.py")
assert wsgiref.util.FileWrapper  # of a deferred package
try:
    import no_such_module
except ModuleNotFoundError:
    print("missing as ever")
"""


def test_deferred_modules_are_loaded_when_used_and_not_before() -> None:
    ran = subprocess.run([sys.executable, "-c", CHECK], capture_output=True, text=True, check=False)
    assert ran.stdout == "missing as ever\n", ran.stderr
