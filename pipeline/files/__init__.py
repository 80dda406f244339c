"""Every file that is read or written apart from a result: its shape, its reader, its writer."""
