"""Files that stages write into a run folder and later stages read: typed, versioned, hashed, with relative paths."""
