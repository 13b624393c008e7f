"""Values that vary from episode to episode."""

from sim2real.composer.variation.base import Variation as Variation
from sim2real.composer.variation.base import evaluate as evaluate
from sim2real.composer.variation.variators import MJCFVariator as MJCFVariator
from sim2real.composer.variation.variators import PhysicsVariator as PhysicsVariator
