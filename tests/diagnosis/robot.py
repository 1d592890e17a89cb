"""The paper's robot: the running example of Zaman et al. 2013 (D5, D35)."""

from holdfast.diagnosis.model import System

POWERED_DOWN = (
    *(f"not on({name})" for name in ("ja", "hu", "la")),
    *(f"not running({name})" for name in ("jn", "hn", "lan", "in", "jyn", "jtn", "hm", "lac")),
    *(f"not ok({topic})" for topic in ("/odom", "/map", "/scan", "/imu_data", "/cmd_vel")),
)
"""What is observed at power-up (D51, D52)."""

ELEVEN = {"ja", "hu", "la", "lan", "lac", "hm", "jn", "hn", "in", "jtn", "jyn"}
"""The paper's diagnosis of it (D52)."""


def paper_robot() -> System:
    """The robot as the paper declares it; `js` and `imu` are named by nobody."""
    robot = System()
    robot.hardware("ja", "hu", "la")
    robot.hardware("js", "imu", switchable=False)
    robot.driver("jn", on=["ja"], out=["/odom"])
    robot.driver("hn", on=["hu"], out=["/scan"])
    robot.driver("lan", on=["la"])
    robot.driver("in", out=["/imu_data"])
    robot.driver("jyn", out=["/joy"])
    robot.node("jtn", out={"/cmd_vel": ["/joy"]})
    robot.node("hm", out={"/map": ["/scan"]})
    robot.node("lac")
    robot.node("rviz")
    robot.related(("jn", "odom.yaw"), ("in", "imu.yaw"))
    return robot
