"""Recordings as segments with residuals, and the compiled programs that evaluate them."""
