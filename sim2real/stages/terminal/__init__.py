"""The terminal: results and messages, and what a signal does to a command."""
