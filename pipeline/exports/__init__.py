"""Results in formats of other tools, one module per format: records in, text or bytes out.
`pipeline.commands.report` writes the files."""
