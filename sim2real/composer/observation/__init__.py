"""Observables and the updater that samples, delays and buffers them."""

from sim2real.composer.observation import observable as observable
from sim2real.composer.observation.updater import DEFAULT_BUFFER_SIZE as DEFAULT_BUFFER_SIZE
from sim2real.composer.observation.updater import DEFAULT_DELAY as DEFAULT_DELAY
from sim2real.composer.observation.updater import DEFAULT_UPDATE_INTERVAL as DEFAULT_UPDATE_INTERVAL
from sim2real.composer.observation.updater import Updater as Updater
