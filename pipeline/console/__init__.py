"""The commands of the command line, by who needs them. Each loads, calls one function and saves."""
