"""The command line's commands: flags, the run loop, import and export, new, info."""
