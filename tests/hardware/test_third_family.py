"""A family of servos is a table: one that nobody has, with its driver, its emulator and all tests of a device."""

from plants import Joints

from sim2real.emulation.conformance import DeviceConformance
from sim2real.emulation.servos import ServoEmulation, ServoFirmware
from sim2real.hardware import feetech
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.registers import Family, Register, ServoModel, eeprom, ram
from sim2real.hardware.bus.servos import PositionDrive, Servos
from sim2real.hardware.device import POSITION as POSITION_KIND

RAD = 6.283185307179586 / 4096
ID, MODE, DELAY = eeprom("id", 5, 1, 0, 253, 1), eeprom("mode", 6, 1, 0, 1), eeprom("return_delay", 7, 1, 0, 254)
LOW, HIGH = eeprom("low", 8, 2, 0, 4095, 0), eeprom("high", 10, 2, 0, 4095, 4095)
TORQUE, GOAL, P = ram("torque", 20, 1, 0, 1), ram("goal", 22, 2, 0, 4095, 0, unit=RAD), ram("p", 24, 2, 0, 9999, 500)
D, SPEED = ram("d", 26, 2, 0, 9999), ram("speed", 28, 2, 0, 4095, unit=RAD)
POSITION, LOAD = Register("position", 40, 2, unit=RAD, sign=15), Register("load", 44, 2, unit=0.001, sign=15)
VELOCITY = Register("velocity", 42, 2, unit=RAD, sign=15)
MODEL, FIRMWARE = Register("model", 0, 2, default=7), Register("firmware", 2, 1, default=4)
VOLTS, WARMTH = Register("voltage", 46, 1, default=74), Register("temperature", 47, 1, default=25)
FAMILY = Family(
    "Acme", feetech.PROTOCOL, list(globals().values()), 96, (1_000_000,),
    torque=TORQUE, modes={POSITION_KIND: (0, GOAL)}, goals=(GOAL,), limits=(LOW, HIGH), mode=MODE,
    model_number=MODEL, servo_id=ID,
    return_delay=DELAY, position=POSITION, velocity=VELOCITY, load=LOAD, controller=(P, D, SPEED), firmware=(FIRMWARE,),
    voltage=VOLTS, temperature=WARMTH, begin={DELAY: 0}, fixed={}, watched=((TORQUE,),), full_rad=500.0,
    models={7: ServoModel("Acme 7", None, "this file")},
)  # fmt: skip


class AcmeServos(Servos):
    family = FAMILY


class AcmeFirmware(ServoFirmware):
    family = FAMILY


class AcmeEmulation(ServoEmulation):
    def servo(self, servo_id):
        return AcmeFirmware(servo_id, 7, self.return_delay_us)


class TestAcme(DeviceConformance):
    emulation, plant = AcmeEmulation, Joints

    def make_device(self, port):
        return AcmeServos(BusConfig(port, max_silence_s=0.5, silence_s=0.6), (1, 2, 3), PositionDrive(800))
