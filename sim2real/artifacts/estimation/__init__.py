"""Parts of an identification's artifact: posterior, noise, links, drift."""
