"""Results in formats of other tools, one module per format: records in, text or bytes out.
`features.exports.command` writes the files."""
