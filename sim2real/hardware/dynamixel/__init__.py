"""DYNAMIXEL X servos: the device, its bus, and the servos that the emulator emulates."""
