"""`python -m boresight`: the command line."""

from boresight.pipeline.cli import main

main()
