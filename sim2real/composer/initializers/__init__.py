"""Initializers that place parts of a world."""

from sim2real.composer.initializers.prop_initializer import PropPlacer as PropPlacer
from sim2real.composer.initializers.tcp_initializer import ToolCenterPointInitializer as ToolCenterPointInitializer
from sim2real.composer.initializers.utils import JointStaticIsolator as JointStaticIsolator
