"""Results in the formats that other tools read, one module a format. Each turns records into text or bytes;
writing files is left to `pipeline.commands.report`."""
