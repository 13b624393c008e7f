"""DYNAMIXEL X servos: tables of registers and models, the bus, the device, and their emulation."""
