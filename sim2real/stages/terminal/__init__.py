"""The terminal: results, messages, and signals that end a command."""
