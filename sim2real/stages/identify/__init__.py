"""The stage identify: parameters, delays and initial states from recordings."""
