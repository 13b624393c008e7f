"""From a starting point to the minimum of the loss: global search, then local refinement."""
