"""A walking robot in C MuJoCo: hidden parameters, the body of the emulator, and episodes of a policy."""
