"""The stage check: whether a recording can determine the parameters."""
