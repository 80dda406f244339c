"""The program with all its commands, for tests that call it within their process."""

from boresight.console import command_line

app = command_line()
