"""Small bags of a robot with two joints that follow their goals 20 ms later, made by ROS 2's own writer."""

import numpy as np
from mcap_ros2.writer import Writer

T0_NS = 1_700_000_000_000_000_000
LATE = 4
"""Samples of 5 ms."""
LINE = "=" * 80 + "\n"
HEAD = (
    f"{LINE}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{LINE}MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
STATE = "sensor_msgs/msg/JointState"
NUMBERS = "std_msgs/msg/Float64MultiArray"
CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
IMAGE = "sensor_msgs/msg/Image"
POINT = (
    f"{LINE}MSG: trajectory_msgs/JointTrajectoryPoint\nfloat64[] positions\nfloat64[] velocities\n"
    f"builtin_interfaces/Duration time_from_start\n{LINE}MSG: builtin_interfaces/Duration\nint32 sec\nuint32 nanosec\n"
)
TYPES = {
    STATE: "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n" + HEAD,
    NUMBERS: "MultiArrayLayout layout\nfloat64[] data\n"
    f"{LINE}MSG: std_msgs/MultiArrayLayout\nMultiArrayDimension[] dim\nuint32 data_offset\n"
    f"{LINE}MSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n",
    IMAGE: "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
    "uint8[] data\n" + HEAD,
    "demo/msg/Note": "wstring text\n",
    "demo/msg/Lost": "demo/Absent inner\n",
    "demo/msg/Loop": f"demo/Loop inner\n{LINE}MSG: demo/Loop\ndemo/Loop inner\n",
    "demo/msg/Many": f"demo/Empty[] many\n{LINE}MSG: demo/Empty\n",
    "demo/msg/Text": "string text\n",
    "tf2_msgs/msg/TFMessage": "float64[] transforms\n",
}


def controller_state(names):
    """Return the definition of a state of a trajectory controller with these points."""
    return (
        "std_msgs/Header header\nstring[] joint_names\n"
        + "".join(f"trajectory_msgs/JointTrajectoryPoint {name}\n" for name in names)
        + HEAD
        + POINT
    )


def motion(count=600, joints=2):
    """Return goals, and positions that follow them, ``(N, joints)`` [rad]: of five tones a joint."""
    t = np.arange(count + LATE) * 0.005
    rng = np.random.default_rng(3)
    waves = [
        np.sin(2 * np.pi * np.outer(t, rng.uniform(0.5, 4, 5)) + rng.uniform(0, 6, 5)).sum(1) for _ in range(joints)
    ]
    goal = 0.1 * np.stack(waves, 1) + 0.3 * np.arange(joints)
    return goal[LATE:], goal[:-LATE] + 1e-4 * rng.standard_normal((count, joints))


GOAL, Q = motion()
STAMPS_NS = T0_NS + 5_000_000 * np.arange(len(Q))


def header(ns):
    return {"stamp": {"sec": int(ns // 10**9), "nanosec": int(ns % 10**9)}, "frame_id": ""}


def state(position, ns, names=("a", "b")):
    return {
        "header": header(ns),
        "name": list(names),
        "position": [*map(float, position)],
        "velocity": [],
        "effort": [],
    }


def point(position):
    return {"positions": [*map(float, position)], "velocities": [], "time_from_start": {"sec": 0, "nanosec": 0}}


def rows(stamp=lambda k, ns: ns, log=lambda k, ns: ns, begin=0, stop=None):
    """Return the rows of a bag of goals and joint states, with changed stamps [ns]."""
    found = []
    for k in range(begin, len(Q) if stop is None else stop):
        at, own = int(log(k, int(STAMPS_NS[k]))), int(stamp(k, int(STAMPS_NS[k])))
        found.append(("/cmd", STATE, state(GOAL[k], own), at + 100_000))
        found.append(("/joint_states", STATE, state(Q[k], own), at + 300_000))
    return found


def write(path, rows, types=None):
    """Write rows (topic, type, message or its bytes, log time [ns]), and return the path."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=64 * 1024)
        schemas = {}
        for topic, kind, message, log_ns in rows:
            if kind not in schemas:
                schemas[kind] = writer.register_msgdef(kind, (types or {}).get(kind, TYPES.get(kind, "")))
            if isinstance(message, bytes):
                channel = writer._writer.register_channel(topic, "cdr", schemas[kind].id)
                writer._writer.add_message(channel, log_ns, message, log_ns)
            else:
                writer.write_message(topic, schemas[kind], message, log_time=log_ns, publish_time=log_ns)
        writer.finish()
    return path
