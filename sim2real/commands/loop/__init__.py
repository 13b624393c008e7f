"""The run loop: the four stages in one run folder, and the iterations that follow from the verdicts."""
