"""All recordings, and all tools that fit them."""
