"""The stage compare: parameters, errors and success of several runs side by side."""
