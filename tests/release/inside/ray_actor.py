"""A Ray of our own starts, and one of its processes answers."""

import sys

from cqn_train.cluster.collector import versions
from cqn_train.cluster.connect import connected
from cqn_train.config import RaySettings
from lerobot_cqn.errors import CQNError

try:
    with connected(RaySettings(actors=1), 1) as ray:
        found = ray.get(ray.remote(versions).remote())
except CQNError as error:
    print(error)
    sys.exit(2)
assert found == versions(), found
print("a process of Ray answers, with the same versions")
