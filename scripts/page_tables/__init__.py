"""Tables of README.md and of pages in docs/, each from reports; ``scripts/readme.py`` writes them."""
