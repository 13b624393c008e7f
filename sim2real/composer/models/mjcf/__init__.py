"""MJCF: its schema, parsing, writing, files, and references between elements."""
