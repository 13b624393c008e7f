"""Models that stay editable, and how they are composed and compiled. Machinery."""
