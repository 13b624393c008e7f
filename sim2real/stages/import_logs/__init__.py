"""The stage import: files of other recorders into logs."""
