"""Types of the public names, for type checkers; ``__init__.py`` imports each name on its first use."""

from sim2real import interop as interop
from sim2real.artifacts.bundle import Bundle as Bundle
from sim2real.artifacts.deployment import Deployment as Deployment
from sim2real.artifacts.identification import Identification as Identification
from sim2real.artifacts.recording import Recording as Recording
from sim2real.artifacts.timing import Timing as Timing
from sim2real.commands.loop import run as run
from sim2real.commands.report import report as report
from sim2real.errors import DeadlineExceeded as DeadlineExceeded
from sim2real.errors import HardwareLost as HardwareLost
from sim2real.errors import SafetyStop as SafetyStop
from sim2real.errors import Sim2RealError as Sim2RealError
from sim2real.errors import UsageError as UsageError
from sim2real.graph import Base as Base
from sim2real.graph import BaseNode as BaseNode
from sim2real.graph import BaseWorld as BaseWorld
from sim2real.graph import Connection as Connection
from sim2real.graph import EmpiricalDist as EmpiricalDist
from sim2real.graph import Empty as Empty
from sim2real.graph import Episode as Episode
from sim2real.graph import GraphState as GraphState
from sim2real.graph import InputState as InputState
from sim2real.graph import Jitter as Jitter
from sim2real.graph import Recorder as Recorder
from sim2real.graph import Scheduling as Scheduling
from sim2real.graph import StaticDist as StaticDist
from sim2real.graph import StepState as StepState
from sim2real.graph import Timeline as Timeline
from sim2real.graph import TrainableDist as TrainableDist
from sim2real.graph.episode import MemoryRecorder as MemoryRecorder
from sim2real.graph.rebuilding import rebuild as rebuild
from sim2real.graph.schedule import draw as draw
from sim2real.runtime.asynchronous import AsyncGraph as AsyncGraph
from sim2real.runtime.clock import Clock as Clock
from sim2real.runtime.compiled.graph import CompiledGraph as CompiledGraph
from sim2real.stages.check.stage import check as check
from sim2real.stages.deploy.stage import deploy as deploy
from sim2real.stages.export import export as export
from sim2real.stages.identify.stage import identify as identify
from sim2real.stages.pipeline.pipeline import Pipeline as Pipeline
from sim2real.stages.pipeline.pipeline import load_pipeline as load_pipeline
from sim2real.stages.record.stage import record as record
from sim2real.stages.train.stage import train as train
from sim2real.stages.validate.stage import validate as validate
from sim2real.training.networks.policy import Policy as Policy
from sim2real.view.graphs import plot_graph as plot_graph
from sim2real.view.graphs import plot_timeline as plot_timeline

__version__: str

def callable_package(name: str) -> None: ...
