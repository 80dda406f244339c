"""How work is spread over processes and kept on disk when finished; what the work is, is not known here."""
