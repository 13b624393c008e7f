"""The two physics engines behind one interface: C MuJoCo and MJX."""
