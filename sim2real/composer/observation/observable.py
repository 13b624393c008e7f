"""The kinds of observables, under the name that dm_control's documents import them by."""

from sim2real.composer.observation.base import AGGREGATORS as AGGREGATORS
from sim2real.composer.observation.base import Generic as Generic
from sim2real.composer.observation.base import MujocoCamera as MujocoCamera
from sim2real.composer.observation.base import MujocoFeature as MujocoFeature
from sim2real.composer.observation.base import Observable as Observable
from sim2real.composer.observation.mjcf import MJCFCamera as MJCFCamera
from sim2real.composer.observation.mjcf import MJCFFeature as MJCFFeature
