"""What keeps a robot safe: gate, guardian, plausibility of measurements, and the rig that joins them."""
