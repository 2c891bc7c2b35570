"""A policy server and a robot client of LeRobot's, on this machine, for one policy; prints what both said."""

import socket
import subprocess
import sys
import time

SERVER_S, CLIENT_S = 60, 15

with socket.socket() as one:
    one.bind(("127.0.0.1", 0))
    port = one.getsockname()[1]
server = subprocess.Popen(
    [sys.executable, "-m", "lerobot.async_inference.policy_server", "--host=127.0.0.1", f"--port={port}"],
    stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
)  # fmt: skip
try:
    deadline = time.monotonic() + SERVER_S
    while time.monotonic() < deadline and server.poll() is None:
        with socket.socket() as probe:
            if not probe.connect_ex(("127.0.0.1", port)):
                break
        time.sleep(0.2)
    client = [
        sys.executable, "-m", "lerobot.async_inference.robot_client", "--robot.type=sim_ur5e", "--robot.id=sim",
        "--robot.state=true", "--robot.camera_names=[]", "--task=Press", f"--server_address=127.0.0.1:{port}",
        "--policy_type=cqn", f"--pretrained_name_or_path={sys.argv[1]}", "--policy_device=cpu",
        "--actions_per_chunk=1", "--fps=10",
    ]  # fmt: skip
    try:
        done = subprocess.run(client, capture_output=True, text=True, check=False, timeout=CLIENT_S + SERVER_S)
        print(done.stdout + done.stderr)
    except subprocess.TimeoutExpired:
        print("the client went on until it was stopped")  # as it does when it is served
finally:
    server.terminate()
    print(server.communicate(timeout=30)[0])
