"""A virtual SO-101 at a table: its motors answer LeRobot's driver, and LeRobot's camera sees it."""

import socket

from lerobot.cameras.zmq import ZMQCamera, ZMQCameraConfig
from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig

from cqn_train.virtual_so101.bench import Bench, BenchConfig

with socket.socket() as free:
    free.bind(("127.0.0.1", 0))
    port = free.getsockname()[1]
with Bench.on(BenchConfig(links={"follower": None}, task="press_button", cameras=port)) as bench:
    robot = SO101Follower(SO101FollowerConfig(port=bench.ports["follower"].name, id="virtual"))
    robot.bus.connect(handshake=True)
    motors = len(robot.bus.broadcast_ping(num_retry=3) or ())
    robot.bus.disconnect(disable_torque=False)
    camera = ZMQCamera(ZMQCameraConfig(server_address="127.0.0.1", port=port, camera_name="front"))
    camera.connect()
    height, width, _ = camera.async_read(timeout_ms=2000).shape
    camera.disconnect()
print(f"{motors} motors answer, a picture of {width}x{height}")
