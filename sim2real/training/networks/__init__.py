"""Networks of policies, their normalisers and their export."""
