"""The kinds of observables, in the module from which dm_control's documents import them."""

from sim2real.composer.observation.observable.base import AGGREGATORS as AGGREGATORS
from sim2real.composer.observation.observable.base import Generic as Generic
from sim2real.composer.observation.observable.base import MJCFCamera as MJCFCamera
from sim2real.composer.observation.observable.base import MJCFFeature as MJCFFeature
from sim2real.composer.observation.observable.base import MujocoCamera as MujocoCamera
from sim2real.composer.observation.observable.base import MujocoFeature as MujocoFeature
from sim2real.composer.observation.observable.base import Observable as Observable
