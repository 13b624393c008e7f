"""What a stage leaves in a run folder and the next one takes: typed, versioned, hashed, with relative paths."""
