"""The live view: a process of its own reads the files that a stage writes, and feeds a Rerun viewer."""
