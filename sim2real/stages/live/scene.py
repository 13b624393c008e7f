"""The robot in 3-D: the scene of its pipeline, otherwise its model."""

from __future__ import annotations

from collections.abc import Mapping

from sim2real.robots.robot import RecordedRobot, Robot
from sim2real.stages.pipeline.pipeline import Pipeline, load_pipeline
from sim2real.types import Json
from sim2real.view.model_scene import ModelScene
from sim2real.view.rerun_recording import Scene


def scene_of(pipeline: Pipeline, robot: RecordedRobot | Robot | None) -> dict[str, Json]:
    """Return what another process needs to draw a robot; empty if the robot has neither a scene nor a model."""
    if pipeline.scene and pipeline.has_commands:
        return {"pipeline": pipeline.name}
    if not isinstance(robot, Robot):
        return {}
    columns = {name: fields["position"] for name, fields in robot.sensor.joints.items() if "position" in fields}
    file = getattr(robot, "mjcf", None)  # of a walking robot, which has no model for others
    return {"mjcf": robot.identified_mjcf(robot.nominal()) or (str(file) if file else None), "columns": columns}


def drawn(scene: Mapping[str, Json]) -> Scene | None:
    """Return the scene that ``scene_of`` describes; None without one."""
    if scene.get("pipeline"):
        pipeline = load_pipeline(scene["pipeline"])
        return pipeline.load(pipeline.scene).log_scene if pipeline.scene else None
    return ModelScene(scene["mjcf"], scene["columns"]) if scene.get("mjcf") else None
