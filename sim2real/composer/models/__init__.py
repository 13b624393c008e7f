"""What a world is made of: models that stay editable, how they are composed and compiled. Machinery."""
