"""The model card of an identification: numbers, limits of the data, and a script that computes each figure again."""
