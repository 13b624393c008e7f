"""Safety of a robot: gate, guardian, plausibility of measurements, and the rig that joins them."""
