"""What all half-duplex buses of servos share: port, packets, registers, transactions."""
