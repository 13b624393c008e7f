"""The vocabulary of graphs and their timing: no threads, no files, no physics."""

from sim2real.graph.base import Base as Base
from sim2real.graph.base import Empty as Empty
from sim2real.graph.base import GraphState as GraphState
from sim2real.graph.base import InputState as InputState
from sim2real.graph.base import StepState as StepState
from sim2real.graph.delays import DelayDistribution as DelayDistribution
from sim2real.graph.delays import EmpiricalDist as EmpiricalDist
from sim2real.graph.delays import StaticDist as StaticDist
from sim2real.graph.delays import TrainableDist as TrainableDist
from sim2real.graph.episode import Episode as Episode
from sim2real.graph.episode import Recorder as Recorder
from sim2real.graph.node import BaseNode as BaseNode
from sim2real.graph.node import BaseWorld as BaseWorld
from sim2real.graph.node import Connection as Connection
from sim2real.graph.node import Jitter as Jitter
from sim2real.graph.node import Scheduling as Scheduling
from sim2real.graph.timeline import Timeline as Timeline
