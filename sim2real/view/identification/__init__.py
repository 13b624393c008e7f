"""The section of an identification on a page, and its figures."""
