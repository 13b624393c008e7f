"""Pipelines: a robot's folder, its robot, logs, parameters and runs, as stages open them."""

from sim2real.stages.pipeline.pipeline import Pipeline as Pipeline
from sim2real.stages.pipeline.pipeline import available as available
from sim2real.stages.pipeline.pipeline import load_pipeline as load_pipeline
