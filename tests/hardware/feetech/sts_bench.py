"""Emulated servos in a thread, in real time, and in virtual time."""

from virtual_bus import PLANTS as PLANTS
from virtual_bus import VirtualBus

from sim2real.hardware.feetech.emulation import StsBus

IDS = (1, 2, 3)


class Bench(VirtualBus):
    """STS servos on it."""

    def __init__(self, *arguments, **plant_args):
        super().__init__(StsBus, *arguments, **plant_args)

    def ask(self, packet, wait_ns=20_000_000):
        """Send a packet and return what is answered until a while later, in one piece."""
        self.send(self.now_ns, packet)
        self.run_until(self.now_ns + wait_ns)
        answers, self.sent = b"".join(answer for _, answer in self.sent), []
        return answers
